"""instant-ngp's snapshots of radiance fields: hash grid and networks in one vector, and the cameras of the training.

The vector holds, without gaps: density network, color network, hash grid. The unit cube is the trainer's; its grid
covers ``aabb``, a cube of ``aabb_scale`` times that edge.
"""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, finite_float32, tensor_error
from regnf_core.importing.families.layers import contradiction, refuse_other_entries, require_family
from regnf_core.importing.families.radiance_field import Radiance
from regnf_core.importing.observing.trajectory import MOST_CAMERAS, Intrinsics, Trajectory, trajectory_of
from regnf_core.importing.radiance.density import RadianceField, fused_layers, tiny_levels
from regnf_core.importing.settings.facts import Rows, is_similarity
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.splats.gaussians import Doubles
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.hash_grid_config import HashGridConfig

FAMILY = "instant_ngp"
_NEAR = 0.1
"""From where on the trainer samples rays, of its unit cube's edge."""
_TOP = 2048.0
"""Of the finest level along the unit cube, where the configuration has no growth."""
_TYPES: dict[str, np.dtype[Any]] = {"__half": np.dtype("<f2"), "float": np.dtype("<f4")}
_INSTEAD = "export its mesh (in the program: Export mesh), and give the mesh"
_BLOCK, _FARTHEST = 16, 1e6


def snapshot_of(tree: Any) -> Keys:
    """The values of a radiance field's snapshot. Raises FieldFormatError: FAMILY_NOT_SUPPORTED."""
    keys = Keys("the snapshot", tree)
    mode = keys.find("snapshot.mode")
    if not isinstance(keys.find("snapshot.nerf"), dict) or mode not in (None, "nerf"):
        raise _unsupported(f"a snapshot of the mode {str(mode)[:20]}")
    if (keys.whole("snapshot.version") or 0) < 1 or not isinstance(keys.find("snapshot.nerf.dataset"), dict):
        raise _unsupported("a snapshot of a release before July 2022, or without its dataset")
    return keys


def read_radiance(keys: Keys, tensor_bytes: int, overrides: UploadDescription) -> Radiance:
    """The density of a snapshot.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, TENSOR_*, SETTINGS_CONTRADICT_TENSORS, INVALID_DESCRIPTION.
    """
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY)
    grid, network = keys.below("encoding"), keys.below("network")
    for part, name, known in (
        (grid, "otype", ("hashgrid", "grid")),
        (grid, "type", ("hash", "")),
        (grid, "hash", ("coherentprime", "")),
        (grid, "interpolation", ("linear", "smoothstep", "")),
        (network, "otype", ("fullyfusedmlp",)),
        (network, "activation", ("relu", "")),
        (network, "output_activation", ("none", "")),
    ):
        if (part.text(name) or "").lower() not in known:
            raise _unsupported(f"a snapshot with {part.at}{name} {str(part.find(name))[:40]}")
    config = _grid(keys, grid)
    if config.width % _BLOCK:
        raise _unsupported(f"a hash grid of {config.width} columns, which the network fills up")
    values = _params(keys, tensor_bytes)
    hidden, outputs = network.whole("n_hidden_layers") or 0, network.whole("n_output_dims") or _BLOCK
    rows = -(-outputs // _BLOCK) * _BLOCK
    own = _numbers(network, config.width, rows)
    fitting = _fitting(keys, values.size - own, config, rows) if own else None
    if fitting is None:
        raise contradiction("the configuration", f"{own} numbers, a color network, {config.entries} rows", values.size)
    layers = fused_layers(values[:own], config.width, hidden, rows)
    table = values[-fitting.entries * fitting.features_per_level :]
    low, high = _box(keys, "snapshot.aabb")
    smooth = (grid.text("interpolation") or "").lower() == "smoothstep"
    field = RadianceField(tiny_levels(fitting, table), layers, low, high, False, 1.0, _NEAR, smooth)
    middle, half = (low + high) / 2.0, np.minimum((high - low) / 2.0, 1.0)
    reach = (middle - half, middle + half)
    turn = keys.matrix("snapshot.render_aabb_to_local", 3, 3)
    if keys.has("snapshot.render_aabb") and (turn is None or np.allclose(turn, np.eye(3))):
        crop = _box(keys, "snapshot.render_aabb")
        cut = np.maximum(reach[0], crop[0]), np.minimum(reach[1], crop[1])
        reach = cut if (cut[0] < cut[1]).all() else reach
    step = keys.whole("snapshot.training_step") or 0
    why = (
        f"instant-ngp's snapshot, step {step}: {config.levels} levels of {config.features_per_level}, "
        f"{len(layers)} layers; the density's activation is taken for the exponential"
    )
    return Radiance(FAMILY, field, reach, why)


def cameras_of(keys: Keys) -> Trajectory:
    """The cameras of the training, in the trainer's unit cube. Raises FieldFormatError: CAMERAS_MALFORMED."""
    dataset = keys.find("snapshot.nerf.dataset")
    frames, seen = (dataset[name] if isinstance(dataset.get(name), list) else [] for name in ("xforms", "metadata"))
    poses, intrinsics = [], []
    for index, (frame, lens) in enumerate(zip(frames[:MOST_CAMERAS], seen, strict=False)):
        # Releases without a rolling shutter have one pose.
        pose = Keys(keys.file, frame if isinstance(frame, dict) else {"start": frame}, f"xforms.{index}.")
        one, rows = Keys(keys.file, lens, f"metadata.{index}."), pose.matrix("start", 3, 4)
        told = [one.numbers(name) or [] for name in ("focal_length", "resolution", "principal_point")]
        if rows is None or any(len(values) != 2 for values in told):
            message = f"{keys.file}: camera {index} has no pose, focal_length, resolution or principal_point"
            raise FieldFormatError(message, reason="CAMERAS_MALFORMED")
        poses.append([*rows, [0.0, 0.0, 0.0, 1.0]])
        (fx, fy), (width, height), (x, y) = told
        intrinsics.append(Intrinsics(fx, fy, x * width, y * height, width, height))
    return trajectory_of(keys.file, np.array(poses, np.float64).reshape(-1, 4, 4), intrinsics, None)


def to_dataset(keys: Keys) -> Rows | None:
    """From the trainer's unit cube to the frame of transforms.json; None where the snapshot does not say."""
    dataset = keys.below("snapshot.nerf.dataset")
    scale, offset = dataset.number("scale"), dataset.numbers("offset")
    if scale is None or not scale > 0.0 or offset is None or len(offset) != 3:
        return None
    # cube = cycled(scale x + offset), where x y z becomes y z x
    turn = np.eye(3) if dataset.flag("from_mitsuba") else np.eye(3)[[2, 0, 1]]
    matrix = np.eye(4)
    with np.errstate(all="ignore"):
        matrix[:3, :3], matrix[:3, 3] = turn / scale, -np.array(offset) / scale
        return [[float(value) for value in row] for row in matrix] if is_similarity(matrix) else None


def _grid(keys: Keys, grid: Keys) -> HashGridConfig:
    features = grid.whole("n_features_per_level") or 2
    total = grid.whole("n_features")
    levels = total // features if total else grid.whole("n_levels") or 16
    log2 = grid.whole("log2_hashmap_size") or 15
    base = grid.whole("base_resolution") or 1 << (log2 // 3)
    growth = grid.number("per_level_scale") or 0.0
    if growth <= 0.0:
        scale = keys.number("snapshot.nerf.aabb_scale") or keys.number("snapshot.nerf.dataset.aabb_scale") or 1.0
        growth = float(np.exp(np.log(np.float32(max(_TOP * scale / base, 1.0))) / max(levels - 1, 1)))
    smooth = (grid.text("interpolation") or "").lower() == "smoothstep"
    bounded = (
        1 <= levels <= 32 and 1 <= features <= 8 and 3 <= log2 <= 24 and 2 <= base <= 1024 and 1.0 <= growth <= 8.0
    )
    if not bounded:
        raise _unsupported(f"a grid of {levels} levels, 2^{log2} entries and growth {growth:g}")
    return HashGridConfig(levels, features, log2, base, growth, interpolation="smoothstep" if smooth else "linear")


def _params(keys: Keys, tensor_bytes: int) -> Float32Array:
    name, raw = str(keys.find("snapshot.params_type") or "__half"), keys.find("snapshot.params_binary")
    kind = _TYPES.get(name)
    if not isinstance(raw, bytes) or kind is None or len(raw) % kind.itemsize:
        raise tensor_error(f"params_binary is no vector of {name[:20]}", "TENSOR_EXPECTED")
    if 4 * len(raw) // kind.itemsize > tensor_bytes:
        raise tensor_error("with params_binary the tensors exceed the limit", "TENSOR_TOO_LARGE")
    return finite_float32("params_binary", np.frombuffer(raw, kind))


def _numbers(network: Keys, columns: int, rows: int) -> int:
    """Of a network's matrices; 0 where it is none that is known."""
    width, hidden = network.whole("n_neurons") or 0, network.whole("n_hidden_layers") or 0
    return width * (columns + rows + (hidden - 1) * width) if 1 <= width <= 1024 and 1 <= hidden <= 8 else 0


def _fitting(keys: Keys, numbers: int, config: HashGridConfig, rows: int) -> HashGridConfig | None:
    """The grid by the rounding under which its table and the color network have so many numbers. rows: of the density
    network, which are columns of the other, beside those of the direction and of what images have of their own."""
    extra = keys.whole("snapshot.nerf.dataset.n_extra_learnable_dims") or 0
    columns = -(-(_direction_columns(keys) + extra) // _BLOCK) * _BLOCK + rows
    own = _numbers(keys.below("rgb_network"), columns, _BLOCK)
    entries, rest = divmod(numbers - own, config.features_per_level)
    if not own or rest:
        return None
    with contextlib.suppress(FieldFormatError):
        return config.with_entry_count(entries)
    return None


def _direction_columns(keys: Keys) -> int:
    """Of spherical harmonics. Raises FieldFormatError (FAMILY_NOT_SUPPORTED) for what may have parameters."""
    nested = keys.find("dir_encoding.nested")
    parts = nested if isinstance(nested, list) and nested else [keys.find("dir_encoding")]
    each = [Keys(keys.file, part, "dir_encoding.") for part in parts[:4]]
    kinds = [(part.text("otype") or "").lower() for part in each]
    if kinds[0] != "sphericalharmonics" or any(kind != "identity" for kind in kinds[1:]):
        raise _unsupported(f"a snapshot whose direction is encoded by {', '.join(kinds)[:60]}")
    return (each[0].whole("degree") or 4) ** 2


def _box(keys: Keys, path: str) -> tuple[Doubles, Doubles]:
    low, high = keys.numbers(f"{path}.min"), keys.numbers(f"{path}.max")
    if low is None or high is None or len(low) != 3 or len(high) != 3 or not _is_box(low, high):
        raise FieldFormatError(f"{keys.file}: {path} is no box", reason="BOUNDS_INVALID")
    return np.array(low), np.array(high)


def _is_box(low: list[float], high: list[float]) -> bool:
    return all(-_FARTHEST < least < most < _FARTHEST for least, most in zip(low, high, strict=True))


def _unsupported(what: str) -> FieldFormatError:
    return FieldFormatError(f"{what} is not supported: {_INSTEAD}", reason="FAMILY_NOT_SUPPORTED")
