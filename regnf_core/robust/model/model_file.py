"""An object's model as a safetensors file of about 50 kB, which saves sampling the object again."""

from __future__ import annotations

import json
import os

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.files import atomic_path
from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.model.object_model import ObjectModel
from regnf_core.robust.model.self_symmetry import SelfSymmetry
from regnf_core.robust.model.signature import SIGNATURE_LENGTH
from regnf_core.robust.samples import Samples
from regnf_core.robust.working_frame import WorkingFrame

MODEL_VERSION = "2"
"""Raised whenever models made by older code must be made again."""
_SHAPES: dict[str, tuple[int | str, ...]] = {
    "center": (3,),
    "lengths": (2,),
    "points": ("N", 3),
    "values": ("N",),
    "normals": ("N", 3),
    "extremes": ("E", 3),
    "symmetry.scale": ("K",),
    "symmetry.rotation": ("K", 3, 3),
    "symmetry.translation": ("K", 3),
    "symmetry.deviation": ("K",),
    "symmetry.axis": ("A", 3),
    "signature": (SIGNATURE_LENGTH,),
}


def write_object_model(path: str | os.PathLike[str], model: ObjectModel) -> None:
    """Write the model atomically."""
    axis = model.symmetry.axis
    tensors = {
        "center": model.frame.center,
        "lengths": torch.tensor([model.frame.length, model.spacing], dtype=torch.float64),
        "points": model.samples.points,
        "values": model.samples.values,
        "normals": model.samples.normals,
        "extremes": model.extremal_points,
        "symmetry.scale": model.symmetry.T.scale,
        "symmetry.rotation": model.symmetry.T.rotation,
        "symmetry.translation": model.symmetry.T.translation,
        "symmetry.deviation": model.symmetry.deviation,
        "symmetry.axis": axis[None] if axis is not None else torch.zeros(0, 3),
        "signature": model.signature,
    }
    content = save(
        {name: tensor.contiguous() for name, tensor in tensors.items()}, {"regnf_object_model": MODEL_VERSION}
    )
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def read_object_model(path: str | os.PathLike[str]) -> ObjectModel:
    """The model in a file that :func:`write_object_model` wrote.

    Raises FieldFormatError (OBJECT_MODEL_INVALID), also for a file of another version: make the model again.
    """
    try:
        with safe_open(os.fspath(path), framework="pt") as file:
            version = (file.metadata() or {}).get("regnf_object_model")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    except (SafetensorError, OSError) as error:
        raise _invalid(f"not a safetensors file: {error}") from error
    if version != MODEL_VERSION:
        raise _invalid(f"version {json.dumps(version)[:20]}, expected {MODEL_VERSION}")
    _check(tensors)
    center, lengths = tensors["center"].double(), tensors["lengths"].double()
    T = Sim3(*(tensors[f"symmetry.{part}"].double() for part in ("scale", "rotation", "translation")))
    axes = tensors["symmetry.axis"]
    return ObjectModel(
        WorkingFrame(center, float(lengths[0])),
        Samples(*(tensors[name].float() for name in ("points", "values", "normals"))),
        float(lengths[1]),
        tensors["extremes"].float(),
        SelfSymmetry(T, axes[0].double() if len(axes) else None, tensors["symmetry.deviation"].float()),
        tensors["signature"].float(),
    )


def _check(tensors: dict[str, Tensor]) -> None:
    """Names, shapes (letters stand for the same count wherever they appear) and finite numbers."""
    if tensors.keys() != _SHAPES.keys():
        raise _invalid(f"unexpected or missing tensors: {sorted(tensors.keys() ^ _SHAPES.keys())[:4]}")
    counts: dict[str, int] = {}
    for name, shape in _SHAPES.items():
        found = tuple(tensors[name].shape)
        fits = len(found) == len(shape) and all(
            have == (counts.setdefault(want, have) if isinstance(want, str) else want)
            for have, want in zip(found, shape, strict=True)
        )
        if not fits or not tensors[name].is_floating_point() or not torch.isfinite(tensors[name]).all():
            raise _invalid(f"{name} has shape {found} or numbers that are not finite")
    if counts["N"] == 0 or counts["E"] == 0 or counts["A"] > 1 or not (tensors["lengths"] > 0).all():
        raise _invalid("no samples, or lengths that are not positive")


def _invalid(detail: str) -> FieldFormatError:
    return FieldFormatError(f"the object's model: {detail}", reason="OBJECT_MODEL_INVALID")
