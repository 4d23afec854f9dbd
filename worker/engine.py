"""Where the worker meets regnf_core: files in, files out. torch is loaded by the methods, in a job's own process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from regnf_core import __version__
from regnf_core.importing.gate import ImportLimits, import_field
from regnf_core.options import RegistrationOptions

Report = Callable[[str, float], None]
Importer = Callable[[Path, Path, dict[str, Any]], dict[str, Any]]
"""(upload, folder, description) -> report; writes folder/field.safetensors. Raises FieldFormatError."""


class RegistrationEngine(Protocol):
    """Registers two safe field files."""

    def describe(self) -> dict[str, Any]:
        """Version and device, for the job's record."""
        ...

    def register(self, scene: Path, object_: Path, request: dict[str, Any], report: Report, folder: Path) -> list[str]:
        """Do what a canonical request asks for, artifacts into ``folder``; their names. Raises RegnfError."""
        ...


@dataclass(frozen=True)
class CoreEngine:
    """The engine of regnf_core on one device."""

    device: str

    @classmethod
    def on(cls, choice: Literal["auto", "cpu", "cuda"]) -> CoreEngine:
        """``auto``: the GPU if torch can use one, else the CPU."""
        import torch

        return cls(("cuda" if torch.cuda.is_available() else "cpu") if choice == "auto" else choice)

    def describe(self) -> dict[str, Any]:
        return {"version": __version__, "device": self.device}

    def register(self, scene: Path, object_: Path, request: dict[str, Any], report: Report, folder: Path) -> list[str]:
        from regnf_core.box import OrientedBox
        from regnf_core.diagnostics import write_artifacts
        from regnf_core.fields.safe_format import open_field
        from regnf_core.registration import register
        from regnf_core.sim3 import Sim3

        start, truth = request.get("initial_transform"), request.get("ground_truth")
        result = register(
            open_field(scene, self.device),
            open_field(object_, self.device),
            OrientedBox.from_quaternion(**request["detection"]),
            RegistrationOptions.from_dict(request["options"]),
            request["seed"],
            report,
            Sim3.from_matrix(start) if start else None,
        )
        report("exporting", 0.95)
        T_true = Sim3.from_matrix(truth["T_object_scene"]) if truth else None
        names: list[str] = write_artifacts(result, folder, truth=T_true)
        return names


def core_importer(limits: ImportLimits) -> Importer:
    """The import gate of regnf_core within ``limits``."""

    def run(upload: Path, folder: Path, description: dict[str, Any]) -> dict[str, Any]:
        return import_field(upload, folder, description or None, limits).to_dict()

    return run
