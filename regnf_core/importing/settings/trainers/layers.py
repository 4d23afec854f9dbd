"""Trainers of plain layers and maps: NeuS, DeepSDF, PIN-SLAM, and settings of none in particular."""

from __future__ import annotations

import itertools

from regnf_core.errors import FieldFormatError
from regnf_core.importing.families.layers import contradiction
from regnf_core.importing.pickle.pickle_machine import Placeholder
from regnf_core.importing.settings.facts import is_similarity, scaled_and_moved
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.settings.said import Said


def _agree_on_skips(keys: Keys, key: str, prefix: str, said: Said) -> None:
    """Raise FieldFormatError (SETTINGS_CONTRADICT_TENSORS) if the layers of ``prefix`` see the input at others than
    ``key`` names. Layers that the network has not are left out, as their trainers do.
    """
    named = keys.wholes(key)
    shapes = [said.facts.weight(f"{prefix}{i}") for i in range(said.facts.count(prefix, ".bias"))]
    if named is None or len(shapes) < 2 or not all(shapes):
        return
    pairs = [(before, after) for before, after in itertools.pairwise(shapes) if before and after]
    found = [i + 1 for i, (before, after) in enumerate(pairs) if before[0] != after[1]]
    expected = sorted({i for i in named if 0 < i < len(shapes)})
    if found != expected:
        raise contradiction(f"{keys.file}: {keys.at}{key}", expected, found)
    said.note(keys, key)


def _agree_on_count(keys: Keys, path: str, dims: list[int] | None, layers: int) -> None:
    if dims is not None and len(dims) != layers - 1:
        raise contradiction(f"{keys.file}: {path}.dims", f"{len(dims)} hidden layers", layers - 1)


# NeuS: the .conf file of a run, of which ``model.sdf_network`` counts, and the cameras' file for the frame.

NEUS_NETWORK = "model.sdf_network"
_MODES = {"idr": "all", "no_view_dir": "no_direction", "no_normal": "no_gradient"}


def neus(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED, SETTINGS_CONTRADICT_TENSORS, FAMILY_NOT_SUPPORTED."""
    network = keys.below(NEUS_NETWORK)
    said.put("family", "neus", network, "d_hidden")
    if network.whole("d_in") not in (None, 3):
        said.refuse(network, "d_in")
    said.take(network, Keys.whole, {"positional_encoding.degree": "multires"})
    scale = network.number("scale")
    if scale is not None:
        if scale <= 0:
            raise network.fault("scale", "a positive number")
        said.put("input_scale", scale, network, "scale")
        said.put("output_scale", 1.0 / scale, network, "scale")
    said.agree(network, "n_layers", said.facts.hidden_layers("sdf_network_fine.lin"))
    first = said.facts.shape("sdf_network_fine.lin0.bias")
    said.agree(network, "d_hidden", first[0] if first else None)
    _agree_on_skips(network, "skip_in", "sdf_network_fine.lin", said)
    said.about_color(lambda: _neus_color(keys.below("model.rendering_network"), said))
    name, arrays = next(((name, found) for name, found in said.documents.arrays if "scale_mat_0" in found), ("", None))
    if arrays is not None:
        frame = arrays.numbers("scale_mat_0")
        if frame.ndim != 2:
            raise FieldFormatError(f"{name}: scale_mat_0 is not a matrix", reason="SETTINGS_MALFORMED")
        if is_similarity(frame.tolist()):
            said.values["dataset_transform"] = frame.tolist()
            said.used.setdefault(name, []).append("scale_mat_0")


def _neus_color(network: Keys, said: Said) -> None:
    mode = network.text("mode")
    if mode is not None and mode not in _MODES:
        said.without_color(network, ["mode"])
    elif mode is not None:
        said.put("color.inputs", _MODES[mode], network, "mode")
    said.take(network, Keys.whole, {"color.direction_degree": "multires_view"})
    said.choose("color.output", network, "squeeze_out", ("sigmoid", "linear"))


# DeepSDF: specs.json, the shapes' latent codes, and how a shape was scaled into the unit sphere.

DEEPSDF_NETWORK = "NetworkSpecs"


def deepsdf(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED, SETTINGS_CONTRADICT_TENSORS, FAMILY_NOT_SUPPORTED."""
    network = keys.below(DEEPSDF_NETWORK)
    said.put("family", "deepsdf", keys, "NetworkArch")
    if keys.text("NetworkArch") not in (None, "deep_sdf_decoder"):
        said.refuse(keys, "NetworkArch")
    said.choose("output_tanh", network, "use_tanh", (2, 1))
    first = said.facts.weight("lin0")
    if first is not None:
        said.agree(keys, "CodeLength", first[1] - 3)
        _agree_on_layers(keys, network, said, first)
    for name, arrays in said.documents.arrays:
        if "offset" in arrays and "scale" in arrays:  # x_field = (x + offset) scale
            offset, scale = arrays.numbers("offset").ravel().tolist(), arrays.numbers("scale").ravel().tolist()
            if len(offset) != 3 or len(scale) != 1 or not scale[0] > 0:
                message = f"{name}: offset and scale are not three numbers and a positive one"
                raise FieldFormatError(message, reason="SETTINGS_MALFORMED")
            said.values["dataset_transform"] = scaled_and_moved(1.0 / scale[0], [-value for value in offset])
            said.used.setdefault(name, []).append("offset and scale")


def _agree_on_layers(keys: Keys, network: Keys, said: Said, first: tuple[int, ...]) -> None:
    """The layers' widths, those that see the whole input once more, and those that see the position."""
    dims, whole, sees = network.wholes("dims"), network.wholes("latent_in"), network.flag("xyz_in_all")
    layers = said.facts.count("lin", ".bias")
    if dims is not None:
        _agree_on_count(keys, DEEPSDF_NETWORK, dims, layers)
        narrower = 3 if sees else 0
        if 1 not in (whole or []) and dims[0] - narrower != first[0]:
            raise contradiction(f"{keys.file}: NetworkSpecs.dims.0", dims[0] - narrower, first[0])
        said.note(network, "dims")
    rows = [said.facts.shape(f"lin{i}.bias") for i in range(layers)]
    columns = [said.facts.weight(f"lin{i}") for i in range(layers)]
    if whole is None or not all(rows) or not all(columns):
        return
    extra = [(c[1] - r[0]) for r, c in zip(rows, columns[1:], strict=False) if r and c]
    found = [i + 1 for i, more in enumerate(extra) if more == first[1]]
    expected = sorted({i for i in whole if 0 < i < layers})
    if found != expected:
        raise contradiction(f"{keys.file}: NetworkSpecs.latent_in", expected, found)
    said.note(network, "latent_in")
    seeing = any(more == 3 != first[1] for more in extra)
    if sees is not None and sees != seeing and layers > 2:
        raise contradiction(f"{keys.file}: NetworkSpecs.xyz_in_all", sees, seeing)


# PIN-SLAM: the YAML of a run. The map's own object holds all that the function needs; here they are compared.

_POINTS = ("voxel_size_m", "search_alpha", "num_nei_cells", "query_nn_k", "weighted_first")
_PIN_SLAM = (*(f"neuralpoints.{name}" for name in _POINTS), "loss.sigma_sigmoid_m", "loss.main_loss_type")
"""Keys of the file; their last parts are the attributes of the map's own configuration."""


def pin_slam(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED, SETTINGS_CONTRADICT_TENSORS."""
    said.put("family", "pin_slam", keys, "setting.name")
    config = said.facts.objects.get("neural_points", {}).get("config")
    held = config.state if isinstance(config, Placeholder) and isinstance(config.state, dict) else {}
    for path in _PIN_SLAM:
        value, found = keys.find(path), held.get(path.rpartition(".")[2])
        if value is None or not isinstance(found, (int, float, str)):
            continue
        same = value == found
        if isinstance(found, float):
            number = keys.number(path)
            same = number is not None and abs(number - found) <= 1e-6 * abs(found)
        if not same:
            raise contradiction(f"{keys.file}: {path}", value, found)
        said.note(keys, path)


# Of any trainer, hydra's among them: the frequency factor of a network of sines; the truncation of a map (Open3D,
# nvblox, KinectFusion's kin).

_SINES_IN = ("", "model.", "network.", "net.", "decoder.", "model.params.")
_FIRST, _HIDDEN = ("first_omega_0", "w0_initial"), ("hidden_omega_0", "w0", "omega_0", "omega", "omega0")
_MAPS_IN = ("", "integrate.", "integration.", "tsdf.", "mapper.", "mapping.")
_LENGTHS = ("sdf_trunc", "truncation", "truncation_distance", "trunc_distance")
_IN_VOXELS = ("trunc_voxel_multiplier", "projective_integrator_truncation_distance_vox", "truncation_distance_vox")
_VOXEL = ("voxel_size", "voxel_size_m", "voxel_length")


def names_frequency(keys: Keys) -> bool:
    """Whether the file has a factor of sines."""
    return _first(keys, _SINES_IN, (*_FIRST, *_HIDDEN)) is not None


def sines(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED."""
    part = next(part for part in _SINES_IN if _first(keys, (part,), (*_FIRST, *_HIDDEN)))
    for entry, names in (("first_activation_scale", _FIRST), ("activation_scale", _HIDDEN)):
        if (key := _first(keys, (part,), names)) is not None:
            said.take(keys, Keys.number, {entry: key})


def names_truncation(keys: Keys) -> bool:
    """Whether the file has a map's truncation."""
    return _first(keys, _MAPS_IN, (*_LENGTHS, *_IN_VOXELS)) is not None


def fusion(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError (SETTINGS_MALFORMED)."""
    length, voxels, voxel = (_first(keys, _MAPS_IN, names) for names in (_LENGTHS, _IN_VOXELS, _VOXEL))
    if length:
        said.take(keys, Keys.number, {"truncation": length})
    elif voxels and voxel:
        said.put("truncation", (keys.number(voxels) or 0.0) * (keys.number(voxel) or 0.0), keys, voxels)
        said.note(keys, voxel)


def _first(keys: Keys, parts: tuple[str, ...], names: tuple[str, ...]) -> str | None:
    return next((f"{part}{name}" for part in parts for name in names if keys.has(f"{part}{name}")), None)
