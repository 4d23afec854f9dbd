"""GICP (Segal et al. 2009) from the package small_gicp, as what it is: refinement after a good start."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch

from benchmarks.peers.clouds import similarity
from benchmarks.peers.disturbance import disturbed
from benchmarks.peers.interface import MissingPackageError, PeerCase, PeerResult
from regnf_core import Sim3

_DEGREES, _SHIFT = 10.0, 0.05  # of the start: about a random axis through the object, object diameters
_RESOLUTION, _REACH = 0.01, 0.1  # object diameters
_ITERATIONS = 100


@dataclass(frozen=True)
class SmallGicp:
    """GICP from the truth turned by 10 degrees and shifted by 5 % of the diameter. The scale is the truth's, kept."""

    name: str = "small_gicp from near the truth"
    given: str = "the true scale; a start 10 degrees and 5 % of the diameter off"
    uses_samples: bool = True

    def register(self, case: PeerCase, seed: int) -> PeerResult:
        """Raises InitializationError for a transform that is none; MissingPackageError."""
        try:
            import small_gicp
        except ImportError as error:
            raise MissingPackageError("small_gicp") from error

        begun = time.perf_counter()
        center = case.object_samples.points.double().mean(0)
        T_start = disturbed(case.truth, center, _DEGREES, _SHIFT * case.diameter, seed)
        unit = torch.tensor(1.0 / case.diameter, dtype=torch.float64)
        to_unit = Sim3(unit, torch.eye(3, dtype=torch.float64), -unit * center.cpu())
        source = (to_unit @ T_start).apply(case.scene_samples.points.double())
        target = to_unit.apply(case.object_samples.points.double())
        found = small_gicp.align(
            target.numpy(),
            source.numpy(),
            np.eye(4),
            registration_type="GICP",
            downsampling_resolution=_RESOLUTION,
            max_correspondence_distance=_REACH,
            max_iterations=_ITERATIONS,
        )
        T = to_unit.inverse() @ similarity(found.T_target_source) @ to_unit @ T_start
        return PeerResult(T, time.perf_counter() - begun, note="converged" if found.converged else "not converged")
