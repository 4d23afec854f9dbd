"""``fit`` and ``fuse``: a neural field from a mesh or from posed images, and a TSDF map from depth images."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from regnf_core.errors import InvalidInputError, InvalidOptionsError, suggestion
from regnf_core.field_files import require_file
from regnf_core.fields.observation import SdfField
from regnf_core.in_memory import field_of
from regnf_core.options import seed_of
from regnf_data.recordings.images import images_of
from regnf_data.recordings.opening import is_recording
from regnf_fit.images.fit import FitFiles, reconstruct
from regnf_fit.images.fusion import FusionOptions, FusionReport, fuse_images
from regnf_fit.mesh import fit_field, mesh_target
from regnf_fit.options import FitOptions, FitReport, ReconstructionOptions, ReconstructionReport

Progress = Callable[[int, float, float], None]
"""Called with the iteration, the loss and the seconds left."""


def fit(
    source: str | os.PathLike[str] | SdfField | Any,
    output: str | Path,
    options: Mapping[str, Any] | None = None,
    extent: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    label: str | None = None,
) -> FitReport | ReconstructionReport:
    """Fit a field and write it to ``output``, a .safetensors file. Returns how well it matches the source.

    source: a mesh file, any field, a mesh of trimesh or Open3D, or a recording of posed images (docs/datasets.md) ·
    options: entries of FitOptions, or for images of ReconstructionOptions · extent: of a mesh file, the length of its
    longest edge after it has been moved to the origin.
    Raises InvalidOptionsError, InvalidInputError (NO_SURFACE_IN_TARGET ...).
    """
    path, seed = _checked_output(Path(output)), seed_of(seed)
    if isinstance(source, SdfField):
        return fit_field(source, path, _options(FitOptions, options), seed, progress, label)
    if not isinstance(source, str | os.PathLike):
        return fit_field(field_of(source, "object"), path, _options(FitOptions, options), seed, progress, label)
    given = Path(source)
    if given.is_dir() or is_recording(given):
        if extent is not None:
            raise InvalidOptionsError(
                "extent is only for meshes: a dataset has its own frame", hint="Leave extent out."
            )
        files = FitFiles(path, path.with_suffix(".checkpoint"))
        chosen = _options(ReconstructionOptions, options)
        images, named = images_of(given).images, {"dataset": given.resolve().name}
        return reconstruct(images, files, chosen, seed=seed, progress=progress, label=label, source=named)
    require_file(given)
    target = mesh_target(given, extent)
    return fit_field(target.field, path, _options(FitOptions, options), seed, progress, label, target.source)


def fuse(
    recording: str | os.PathLike[str],
    output: str | Path,
    options: Mapping[str, Any] | None = None,
    bounds: ArrayLike | None = None,
    progress: Callable[[int], None] | None = None,
    label: str | None = None,
) -> FusionReport:
    """Fuse the depth images of a recording into a TSDF map and write it to ``output``, a .safetensors file. Returns a
    summary of the map.

    recording: a path, in any layout of docs/datasets.md · options: entries of FusionOptions · bounds: (2, 3), lowest
    and highest corner of the map's region; None: the region that the images show · progress: called with the images
    that are fused. Raises InvalidOptionsError, InvalidInputError, DatasetError (DATASET_FRAMES_DISAGREE ...).
    """
    path, chosen = _checked_output(Path(output)), _options(FusionOptions, options)
    box = None if bounds is None else np.asarray(bounds, np.float64).reshape(2, 3)
    images = images_of(recording, None, box).images
    return fuse_images(images, path, chosen, progress, label, {"dataset": Path(recording).resolve().name})


def _checked_output(path: Path) -> Path:
    """Refuse before the work what would fail after it."""
    if path.suffix != ".safetensors":
        hint = f"Write {path.with_suffix('.safetensors')}."
        raise InvalidOptionsError(f"{path}: expected a name that ends in .safetensors", hint=hint)
    if not path.parent.is_dir():
        hint = f"Make it: mkdir -p {path.parent}"
        raise InvalidInputError(f"{path.parent}: no such folder", reason="FILE_NOT_FOUND", hint=hint)
    return path


def _options(kind: Any, given: Mapping[str, Any] | None) -> Any:
    known = [one.name for one in fields(kind)]
    for name in given or {}:
        if name not in known:
            hint = suggestion(name, known) or f"The options are {', '.join(known)}."
            raise InvalidOptionsError(f"options.{name}: no such option", hint=hint)
    return kind(**(given or {}))
