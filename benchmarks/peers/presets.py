"""regnf's own two presets behind the same interface."""

from __future__ import annotations

import time
from dataclasses import dataclass

from benchmarks.peers.interface import PeerCase, PeerResult
from regnf_core import RegistrationOptions, register
from regnf_core.options import Preset


@dataclass(frozen=True)
class RegnfPreset:
    """A preset with its default options. It takes samples of its own, so the shared ones are no part of its cost.

    A `rejected` result of `robust` counts as no pose: it says itself that the pose is not to be used. The published
    method has no verdict, so what `paper` finds counts as a pose whatever regnf's verification says of it.
    """

    preset: Preset
    given: str = ""
    uses_samples: bool = False

    @property
    def name(self) -> str:
        return f"regnf {self.preset}"

    def register(self, case: PeerCase, seed: int) -> PeerResult:
        """Raises RegnfError as regnf_core.register does. The seconds leave out the clouds made for pictures."""
        begun = time.perf_counter()
        result = register(case.scene, case.obj, case.detection, RegistrationOptions(preset=self.preset), seed)
        seconds = time.perf_counter() - begun - result.metrics["seconds_exporting"]
        refused = self.preset == "robust" and result.verdict == "rejected"
        return PeerResult(
            None if refused else result.T_object_scene,
            seconds,
            int(result.metrics["field_evaluations"]),
            f"{result.verdict}: {result.verdict_reason}",
        )
