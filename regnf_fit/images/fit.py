"""Fitting a neus-facto field to posed images."""

from __future__ import annotations

import contextlib
import hashlib
import math
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from regnf_core.errors import FitDivergedError, InvalidInputError, InvalidOptionsError, NoSurfaceError
from regnf_core.fields.build import usable_device
from regnf_core.fields.neus_facto import NeusFactoField
from regnf_core.fields.observation import Observation
from regnf_core.schema.color import COLOR
from regnf_core.schema.observation_grid import OBSERVATION
from regnf_core.schema.safe_format import write_safe_field
from regnf_core.viewing.field_picture import field_picture
from regnf_data.posed_images import PosedImages
from regnf_fit.images.capacity import suited
from regnf_fit.images.checkpoint import read_checkpoint, write_checkpoint
from regnf_fit.images.checks import check_bounds
from regnf_fit.images.color_export import stored_color
from regnf_fit.images.coloring import SurfaceColor, fit_color
from regnf_fit.images.held_out import evaluate
from regnf_fit.images.held_out_images import held_out_images, likeness
from regnf_fit.images.map_distances import MapDistances, map_distances
from regnf_fit.images.network import RadianceField
from regnf_fit.images.observing import observe
from regnf_fit.images.options import ReconstructionOptions, ReconstructionReport
from regnf_fit.images.preparation import PreparedImages, prepare
from regnf_fit.images.sdfstudio_export import write_sdfstudio
from regnf_fit.images.trainer import Trainer
from regnf_fit.local_frame import LocalFrame
from regnf_fit.network import GRID_RADIUS
from regnf_fit.options import FitProgress

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
    torch_device = pick_device(device)
    rng = np.random.default_rng(seed)
    key = _key(images, options, seed)
    check_bounds(images.bounds)
    frame = LocalFrame.in_grid(images.bounds, GRID_RADIUS)
    given, images = images, frame.enter(images)
    prepared = prepare(images, options.start, rng, given)
    options = suited(options, prepared)
    trainer = Trainer(prepared, options, seed, torch_device, rng, _near(images, prepared, options, rng))
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
    color = _fit_color(trainer, prepared, chosen, seed)
    _write_all(trainer, files, write, color)
    errors = evaluate(trainer.averaged, held_out, prepared.size)
    alike = None if color is None else likeness(trainer.averaged, color, images, chosen, prepared.size)
    return ReconstructionReport(
        loss=loss,
        psnr=None if alike is None else alike.psnr,
        ssim=None if alike is None else alike.ssim,
        pose_shift=None if trainer.poses is None else trainer.poses.median_shift() / frame.scale,
        iterations=options.iterations,
        seconds=time.monotonic() - started,
        depth_error=None if errors.depth_error is None else errors.depth_error / frame.scale,
        depth_error_median=None if errors.depth_error_median is None else errors.depth_error_median / frame.scale,
        eikonal_error=errors.eikonal_error,
        warnings=prepared.warnings,
    )


def _write_all(trainer: Trainer, files: FitFiles, write: _Writer, color: SurfaceColor | None) -> None:
    """Write what the caller asked for. What the fit would have gone on from is no longer needed."""
    write(trainer, files.output, color)
    if files.pictures:
        _draw(trainer.averaged, write.bounds, files.output.with_suffix(".png"))
    if files.sdfstudio is not None:
        sharpness = float(trainer.sharpness().detach())
        write_sdfstudio(trainer.averaged, write.bounds, sharpness, files.sdfstudio, write.frame)
    if files.checkpoint is not None:
        files.checkpoint.unlink(missing_ok=True)


def _near(
    images: PosedImages, prepared: PreparedImages, options: ReconstructionOptions, rng: np.random.Generator
) -> MapDistances | None:
    """Distances of the map that the depths fuse to: in rooms whose poses are believed. Otherwise rays tell them."""
    if not prepared.has_depth or not prepared.start.hollow or options.refine_poses:
        return None
    return map_distances(images, prepared, rng)


def _fit_color(trainer: Trainer, prepared: PreparedImages, held_out: list[int], seed: int) -> SurfaceColor | None:
    """The color of the finished geometry, without the images ``held_out``; None where no color is wanted or seen."""
    if not trainer.learns_color:
        return None
    rays = prepared.training
    rays = rays.take(~torch.isin(rays.images, torch.tensor(held_out, dtype=rays.images.dtype)))
    rays = rays.to(trainer.field.table.device)
    with torch.no_grad():
        rays = rays if trainer.poses is None else trainer.poses.correct(rays)
    return fit_color(trainer.averaged, rays, prepared.size, seed)


def pick_device(name: str) -> torch.device:
    """``auto``: an NVIDIA GPU where there is one. Raises InvalidOptionsError."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name not in ("cpu", "cuda"):
        raise InvalidOptionsError(f"the device is auto, cpu or cuda, not {name:.40}")
    return usable_device(name)


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
                raise FitDivergedError(f"the fit diverged about iteration {done}")
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
