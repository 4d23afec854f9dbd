"""How well every reference checkpoint is reproduced, with no hint what it is.

    python -m benchmarks.reference_checkpoints FORMATS [--output benchmarks/results/reference_checkpoints.md]

FORMATS has a folder a family: a checkpoint as its trainer leaves it, points, and the values and gradients that the
family's own code computed there. Each file goes through the whole gate. Ends with status 1 if a bar is missed.
"""

from __future__ import annotations

import argparse
import platform
import sys
import tempfile
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from regnf_core.fields.build import open_field
from regnf_core.importing.gate.gate import FIELD_NAME, import_field

VALUE_BAR, GRADIENT_BAR = 1e-5, 1e-3
CHECKPOINTS = {
    "sdfstudio_neus_facto": "*.ckpt",
    "sdfstudio_neus_facto_angelo": "*.ckpt",
    "sdfstudio_neus": "*.ckpt",
    "nerfstudio_neus_facto": "*.ckpt",
    "neus": "ckpt_*.pth",
    "instant_nsr_pl": "*.ckpt",
    "neuralangelo": "*_checkpoint.pt",
    "deepsdf": "ModelParameters/latest.pth",
    "siren": "model_current.pth",
    "pin_slam": "pin_map.pth",
    "dense_sdf_grid": "sdf_grid.npz",
    "open3d_voxel_block_grid": "vbg_torus.npz",
}
"""The one file of each folder that is uploaded."""


@dataclass(frozen=True)
class Reproduction:
    """family: what the gate called it · value: largest error, of the values' range · gradient: largest error of a
    component · beyond: points at which either bar is missed, of ``points``."""

    family: str
    value: float
    gradient: float
    beyond: int
    points: int
    warnings: tuple[str, ...]


def description(folder: Path) -> dict[str, Any] | None:
    """What the checkpoint cannot hold: DeepSDF keeps its shapes' codes in another file."""
    if folder.name != "deepsdf":
        return None
    return {"latent": np.load(folder / "latent.npy").ravel().tolist()}


def reproduce(folder: Path, out: Path) -> Reproduction:
    """One family's file through the gate, compared at its reference points."""
    (upload,) = folder.rglob(CHECKPOINTS[folder.name])
    report = import_field(upload, out, description(folder))
    points = torch.from_numpy(np.load(folder / "points.npy"))
    distance, gradient = open_field(out / FIELD_NAME).signed_distance_and_gradient(points)
    expected = np.load(folder / "sdf.npy").reshape(-1)
    value = np.abs(distance.numpy() - expected) / np.ptp(expected)
    turned = np.abs(gradient.numpy() - np.load(folder / "gradient.npy")).max(axis=1)
    defined = _defined(folder, len(expected))
    beyond = ((value > VALUE_BAR) | (turned > GRADIENT_BAR)) & defined
    return Reproduction(
        report.family,
        float(value[defined].max()),
        float(turned[defined].max()),
        int(beyond.sum()),
        int(defined.sum()),
        tuple(report.warnings),
    )


def _defined(folder: Path, count: int) -> NDArray[np.bool_]:
    """Where the family's own code has an answer: a neural point map has none far from its points."""
    path = folder / "valid.npy"
    return np.load(path).reshape(-1).astype(bool) if path.exists() else np.ones(count, bool)


def row(name: str, found: Reproduction) -> str:
    met = "met" if found.beyond == 0 and found.family == name else "missed"
    warnings = ", ".join(found.warnings) or "none"
    return (
        f"| {name} | {found.family} | {found.value:.1e} | {found.gradient:.1e} | "
        f"{found.beyond} of {found.points} | {warnings} | {met} |"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("formats", type=Path)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    rows = []
    for name in CHECKPOINTS:
        with tempfile.TemporaryDirectory(prefix="regnf-reference-") as out:
            rows.append(row(name, reproduce(arguments.formats / name, Path(out))))
    text = "\n".join(
        [
            f"Command: `python -m benchmarks.reference_checkpoints FORMATS`, {datetime.now(UTC):%Y-%m-%d}, "
            f"{platform.system()} {platform.machine()}, torch {torch.__version__}",
            "",
            f"Bars: values within {VALUE_BAR:g} of their range, gradients within {GRADIENT_BAR:g}, at every point; the "
            "family named without a hint. DeepSDF is given its shape's code, which lies in another file.",
            "",
            "| checkpoint | recognized as | largest value error, of the range | largest gradient error | "
            "points beyond a bar | warnings | |",
            "|---|---|---|---|---|---|---|",
            *rows,
        ]
    )
    sys.stdout.write(text + "\n")
    if arguments.output:
        arguments.output.write_text(f"# Reference checkpoints\n\n{text}\n")
    return int(any(line.endswith("missed |") for line in rows))


if __name__ == "__main__":
    sys.exit(main())
