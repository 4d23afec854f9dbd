"""Fitting a neus-facto field to posed images."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import pickle
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.errors import FitDivergedError, InvalidInputError, InvalidOptionsError, NoSurfaceError, atomic_path
from regnf_core.fields.build import usable_device
from regnf_core.fields.neus_facto import NeusFactoField
from regnf_core.fields.observation import Observation
from regnf_core.schema.description import COLOR, OBSERVATION, DirectionEncoding, NetworkColor, color_tensors
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.safe_format import write_safe_field
from regnf_core.viewing.field_picture import field_picture
from regnf_data.posed_images import PosedImages
from regnf_fit.images.checks import check_bounds
from regnf_fit.images.coloring import (
    COLOR_INPUTS,
    DIRECTION_DEGREE,
    RadianceField,
    SurfaceColor,
    evaluate,
    fit_color,
    held_out_images,
    likeness,
)
from regnf_fit.images.fusion import map_distances, measured_rays, sharp_width
from regnf_fit.images.observing import observe
from regnf_fit.images.preparation import PreparedImages, cells_of, ends_of, prepare
from regnf_fit.images.trainer import Trainer
from regnf_fit.local_frame import LocalFrame
from regnf_fit.network import GRID_RADIUS, POSITION_DEGREE, arrays_of, layer_tensors
from regnf_fit.options import OF_IMAGES, FitProgress, ReconstructionOptions, ReconstructionReport, grid_of_levels

# How large a network images need: a grid as fine as their pixels, with an entry for each cell that shows surface.
#
# A hash grid covers [-2, 2]^3, whatever the bounds. In a room of that size an object is a few per cent of it, and its
# surface is only one of many that share the table: one size of grid cannot suit a cup and a room alike.

_LEVELS = {512: 8, 1024: 9}
"""Of a grid with so many nodes along an edge: neighboring levels differ by a factor of about 1.65."""
_LEAST_LOG2, _MOST_LOG2 = 15, 18


def grid_of(prepared: PreparedImages, table_log2: int | None = None) -> HashGridConfig:
    """The grid whose finest cells are about as wide as a pixel of the sharper images at its surface, and whose levels
    have an entry for every such cell that shows surface; within limits. Without depths: the smallest.

    table_log2: log2 of the entries a level, where they are given.
    """
    surface = measured_rays(prepared)
    if len(surface) == 0:
        return grid_of_levels(_LEVELS[min(_LEVELS)], min(_LEVELS), table_log2 or _LEAST_LOG2)
    width = sharp_width(prepared, surface)
    nodes = 2 ** math.ceil(math.log2(2.0 * GRID_RADIUS / width))
    nodes = min(max(nodes, min(_LEVELS)), max(_LEVELS))
    cells = cells_of(ends_of(surface), 2.0 * GRID_RADIUS / nodes)
    needed = min(max(math.ceil(math.log2(len(cells.counts))), _LEAST_LOG2), _MOST_LOG2)
    return grid_of_levels(_LEVELS[nodes], nodes, table_log2 or needed)


# A fit's state on disk, so that an interrupted fit goes on as if it had not been.

_VERSION = 4


def write_checkpoint(path: Path, state: dict[str, Any], key: str) -> None:
    """Write a trainer's state atomically. key: of the data and options that it belongs to."""
    with atomic_path(path, durable=True) as temporary, temporary.open("xb") as file:
        torch.save({"version": _VERSION, "key": key, "state": state}, file)


def read_checkpoint(path: Path, key: str) -> dict[str, Any]:
    """The state in ``path``. Raises InvalidInputError (CHECKPOINT_INVALID, CHECKPOINT_OF_ANOTHER_FIT)."""
    try:
        content = torch.load(path, weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, ValueError, KeyError):
        content = None
    if not isinstance(content, dict) or content.get("version") != _VERSION:
        raise InvalidInputError(f"{path.name} is not a checkpoint of a fit", reason="CHECKPOINT_INVALID")
    if content.get("key") != key:
        message = f"{path.name} belongs to a fit of other data or options"
        raise InvalidInputError(message, reason="CHECKPOINT_OF_ANOTHER_FIT")
    state: dict[str, Any] = content["state"]
    return state


# The color of a fitted field as a regnf field file keeps it: a network that follows the geometry's.

_FORM = NetworkColor("network", direction=DirectionEncoding("frequency", DIRECTION_DEGREE), gradient="unit")


def stored_color(field: RadianceField) -> tuple[dict[str, Any], dict[str, NDArray[np.float32]]]:
    """The description's entry, and the tensors by their names in the file.

    No activation stands between the geometry's feature and the color's first layer: they are one layer of the file.
    """
    weights, biases = ([part.detach().double().cpu() for part in p] for p in (field.color_weights, field.color_biases))
    own, features = weights[0][:, :COLOR_INPUTS], weights[0][:, COLOR_INPUTS:]
    weights[0] = torch.cat((own, features @ field.feature_weight.detach().double().cpu()), dim=1)
    biases[0] = biases[0] + features @ field.feature_bias.detach().double().cpu()
    layers = {name: part.float() for name, part in layer_tensors(weights, biases).items()}
    return asdict(_FORM), color_tensors(arrays_of(layers))


# A fitted field in the layout of sdfstudio's neus-facto checkpoints, colors included.

_EMBEDDING = 32
"""Columns of the color's network for an image's appearance, which our fields do not have: zeros."""


def write_sdfstudio(field: RadianceField, bounds: Tensor, sharpness: float, path: Path, frame: LocalFrame) -> None:
    """Write a checkpoint {step, pipeline} to ``path`` atomically. bounds: (2, 3), the field's frame · frame: that one;
    where it is not the images' own, dataparser_transforms.json beside the checkpoint says how it lies in theirs.

    The distances are those of the field before its table is rounded to half precision. What the tensors do not say
    stands in ``config.yml`` beside it, as sdfstudio names it; a file of that name that is there already stays.
    """
    entries: dict[str, Tensor] = {"aabb": bounds.float(), "encoding.params": field.table.flatten()}
    shape = [list(layer) for layer in zip(field.weights, field.biases, strict=True)]
    color = [list(layer) for layer in zip(field.color_weights, field.color_biases, strict=True)]
    # the feature's rows follow the distance's
    shape[-1] = [torch.cat((shape[-1][0], field.feature_weight)), torch.cat((shape[-1][1], field.feature_bias))]
    color[0][0] = torch.nn.functional.pad(color[0][0], (0, _EMBEDDING))
    for name, layers in (("glin", shape), ("clin", color)):
        for i, (weight, bias) in enumerate(layers):  # W = g v / |v|, row by row; here v = W
            entries[f"{name}{i}.weight_g"] = weight.norm(dim=1, keepdim=True)
            entries[f"{name}{i}.weight_v"], entries[f"{name}{i}.bias"] = weight, bias
    # sdfstudio keeps a tenth of the sharpness's logarithm; the density of VolSDF beside it is not used
    entries["deviation_network.variance"] = torch.tensor([math.log(sharpness) / 10.0])
    entries["laplace_density.beta"] = torch.tensor([0.1])
    entries["laplace_density.beta_min"] = torch.tensor([1e-4])
    entries["embedding_appearance.embedding.weight"] = torch.zeros(1, _EMBEDDING)
    pipeline = {f"_model.field.{name}": value.detach().cpu().clone() for name, value in entries.items()}
    with atomic_path(path) as temporary:
        torch.save({"step": field.options.iterations, "pipeline": pipeline}, temporary)
    if not frame.same:
        turn = [[*row, -float(shift)] for row, shift in zip(np.eye(3).tolist(), frame.origin, strict=True)]
        with atomic_path(path.with_name("dataparser_transforms.json")) as temporary:
            temporary.write_text(json.dumps({"transform": turn, "scale": frame.scale}), encoding="utf-8")
    settings = path.with_name("config.yml")
    if not settings.exists():
        with atomic_path(settings) as temporary:
            temporary.write_text(yaml.safe_dump(_settings(field), sort_keys=False), encoding="utf-8")


def _settings(field: RadianceField) -> dict[str, Any]:
    grid = field.options.grid
    sdf_field = {
        "num_layers": field.options.hidden_layers,
        "hidden_dim": field.options.hidden_width,
        "use_grid_feature": True,
        "encoding_type": "hash",
        "num_levels": grid.levels,
        "max_res": round(grid.scales()[-1]) + 1,
        "base_res": grid.base_resolution,
        "log2_hashmap_size": grid.log2_table_size,
        "hash_features_per_level": grid.features_per_level,
        "hash_smoothstep": grid.interpolation == "smoothstep",
        "position_encoding_max_degree": POSITION_DEGREE,
        "use_position_encoding": True,
    }
    return {"method_name": "neus-facto", "pipeline": {"model": {"sdf_field": sdf_field}}}


_REPORT_EVERY = 25
_CHECKPOINTS = 10
_PICTURES = (0.03, 0.1, 0.3)


@dataclass(frozen=True)
class FitFiles:
    """Where a fit writes. snapshots: shares of the iterations, in (0, 1), after which the field is written as
    NAME-after-3-percent beside ``output`` · checkpoint: kept until the fit is done, and gone on from if it is there."""

    output: Path
    checkpoint: Path | None = None
    snapshots: tuple[float, ...] = ()
    pictures: bool = False
    """Draw the field after 3, 10 and 30 % of the iterations and at the end, beside ``output``, as .png."""
    sdfstudio: Path | None = None
    """The field with its colors in the layout of sdfstudio's checkpoints, if wanted."""


def reconstruct(
    images: PosedImages,
    files: FitFiles,
    options: ReconstructionOptions | None = None,
    seed: int = 0,
    device: str = "auto",
    progress: FitProgress | None = None,
    label: str | None = None,
    source: dict[str, Any] | None = None,
) -> ReconstructionReport:
    """Fit a field to ``images``, write it in the safe format, and say how well it agrees with pixels held out.

    The field's frame is the images' world frame, its bounds are theirs; bounds beyond the hash grid are fitted in a
    frame of their own, and placed in the world. Deterministic for ``seed`` on one machine's
    CPU, interrupted or not. Raises DatasetError, FitDivergedError and InvalidInputError (CHECKPOINT_...).
    """
    options = options or ReconstructionOptions()
    started = time.monotonic()
    if device not in ("auto", "cpu", "cuda"):
        raise InvalidOptionsError(f"the device is auto, cpu or cuda, not {device:.40}")
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    torch_device = usable_device(device)
    rng = np.random.default_rng(seed)
    key = _key(images, options, seed)
    check_bounds(images.bounds)
    frame = LocalFrame.in_grid(images.bounds, GRID_RADIUS)
    given, images = images, frame.enter(images)
    prepared = prepare(images, options.start, rng, given)
    if options.grid is OF_IMAGES:
        options = replace(options, grid=grid_of(prepared, options.table_log2))
    # in rooms whose poses are believed, the map that the depths fuse to tells distances; otherwise rays do
    mapped = prepared.has_depth and prepared.start.hollow and not options.refine_poses
    near = map_distances(images, prepared, rng) if mapped else None
    trainer = Trainer(prepared, options, seed, torch_device, rng, near)
    observation = observe(images, options.observation_voxels, prepared.spread)
    write = _Writer(prepared.bounds, label, source or {}, observation, frame)
    if files.checkpoint is not None and files.checkpoint.exists():
        trainer.resume(read_checkpoint(files.checkpoint, key))
    loss = _train(trainer, files, key, write, progress)
    held_out = prepared.held_out.to(torch_device)
    if trainer.poses is not None:
        images = trainer.poses.corrected(images)
        write = replace(write, observation=observe(images, options.observation_voxels, prepared.spread))
        with torch.no_grad():
            held_out = trainer.poses.correct(held_out)
    chosen = held_out_images(len(images.colors))
    color = None
    if trainer.learns_color:  # of the finished geometry, without the images ``chosen``
        rays = prepared.training
        rays = rays.take(~torch.isin(rays.images, torch.tensor(chosen, dtype=rays.images.dtype))).to(torch_device)
        with torch.no_grad():
            rays = rays if trainer.poses is None else trainer.poses.correct(rays)
        color = fit_color(trainer.averaged, rays, prepared.size, seed)
    write(trainer, files.output, color)
    if files.pictures:
        _draw(trainer.averaged, write.bounds, files.output.with_suffix(".png"))
    if files.sdfstudio is not None:
        sharpness = float(trainer.sharpness().detach())
        write_sdfstudio(trainer.averaged, write.bounds, sharpness, files.sdfstudio, frame)
    if files.checkpoint is not None:
        files.checkpoint.unlink(missing_ok=True)
    errors = evaluate(trainer.averaged, held_out, prepared.size)
    alike = None if color is None else likeness(trainer.averaged, color, images, chosen, prepared.size)
    psnr, ssim = alike or (None, None)
    return ReconstructionReport(
        loss=loss,
        psnr=psnr,
        ssim=ssim,
        pose_shift=None if trainer.poses is None else trainer.poses.median_shift() / frame.scale,
        iterations=options.iterations,
        seconds=time.monotonic() - started,
        depth_error=None if errors.depth_error is None else errors.depth_error / frame.scale,
        depth_error_median=None if errors.depth_error_median is None else errors.depth_error_median / frame.scale,
        eikonal_error=errors.eikonal_error,
        warnings=prepared.warnings,
    )


def _train(
    trainer: Trainer,
    files: FitFiles,
    key: str,
    write: _Writer,
    progress: FitProgress | None,
) -> float:
    """Run the iterations that are left; the mean loss of the last ones."""
    total = trainer.options.iterations
    snapshots = {max(1, round(share * total)): share for share in files.snapshots}
    pictures = {max(1, round(share * total)): share for share in _PICTURES if files.pictures}
    interval = max(1, total // _CHECKPOINTS)
    started, first = time.monotonic(), trainer.iteration
    recent = math.nan
    while trainer.iteration < total:
        trainer.step()
        done = trainer.iteration
        if (done in snapshots or done in pictures) and not trainer.is_finite():
            raise FitDivergedError(f"the fit diverged before iteration {done}")
        if done in snapshots:
            write(trainer, snapshot_path(files.output, snapshots[done]))
        if done in pictures:
            drawn = snapshot_path(files.output, pictures[done]).with_suffix(".png")
            _draw(trainer.averaged, write.bounds, drawn)
        if done % _REPORT_EVERY == 0 or done == total or done % interval == 0:
            recent = trainer.mean_loss()
            if not math.isfinite(recent) or not trainer.is_finite():
                raise FitDivergedError(f"the fit diverged at about iteration {done}")
            if files.checkpoint is not None and done % interval == 0 and done < total:
                write_checkpoint(files.checkpoint, trainer.state(), key)
            if progress is not None:
                progress(done, recent, (time.monotonic() - started) / (done - first) * (total - done))
    return recent


def snapshot_path(output: Path, share: float) -> Path:
    """Where the field after a share of the iterations goes: NAME-after-3-percent.safetensors."""
    return output.with_name(f"{output.stem}-after-{100.0 * share:g}-percent{output.suffix}")


def _draw(field: RadianceField, bounds: torch.Tensor, path: Path) -> None:
    """A picture of the field as it is; none where it has no surface, or is not finite."""
    with contextlib.suppress(NoSurfaceError, InvalidInputError):
        field_picture(NeusFactoField(field.function(), bounds)).save(path)


@dataclass(frozen=True)
class _Writer:
    """Writes fields of one fit."""

    bounds: torch.Tensor
    label: str | None
    source: dict[str, Any]
    observation: Observation | None
    frame: LocalFrame

    def __call__(self, trainer: Trainer, path: Path, color: SurfaceColor | None = None) -> None:
        """The moving average of what ``trainer`` has learned. color: the geometry's, where it is finished."""
        field = trainer.averaged
        description = field.description(self.bounds, self.label, self.source)
        tensors = field.tensors()
        description["inverse_deviation"] = float(trainer.sharpness().detach())
        if trainer.learns_color:
            half = field.options.half_table
            description[COLOR], colors = stored_color(field) if color is None else color.stored(half)
            tensors |= colors
        if self.observation is not None:
            grid, tensors[OBSERVATION] = self.observation.stored()
            description[OBSERVATION] = asdict(grid)
        write_safe_field(path, self.frame.leave(description), tensors)


def _key(images: PosedImages, options: ReconstructionOptions, seed: int) -> str:
    """Tells one fit from another: of the pixels, cameras, options and seed."""
    digest = hashlib.sha256(repr((options, seed)).encode())
    for array in (images.colors, images.depths, images.masks, images.intrinsics, images.T_world_camera, images.bounds):
        if array is not None:
            digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
