"""KISS-Matcher (Lim et al., ICRA 2025) from its package kiss-matcher."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from benchmarks.peers.clouds import cloud_pair
from benchmarks.peers.interface import MissingPackageError, PeerCase, PeerResult
from regnf_core.errors import InitializationError


@dataclass(frozen=True)
class KissMatcher:
    """Its own features, pruning and solver with the package's settings; only the voxel is set. It has no scale.

    Nothing refines the pose afterwards: the package stops there.
    """

    normalized: bool
    uses_samples: bool = True

    @property
    def name(self) -> str:
        return "kiss_matcher normalized" if self.normalized else "kiss_matcher"

    @property
    def given(self) -> str:
        return "both clouds scaled to the same root mean square radius" if self.normalized else ""

    def register(self, case: PeerCase, seed: int) -> PeerResult:  # noqa: ARG002 (the package draws no random numbers)
        """Raises InitializationError when it finds its own solution invalid; MissingPackageError."""
        try:
            import kiss_matcher
        except ImportError as error:
            raise MissingPackageError("kiss-matcher") from error

        begun = time.perf_counter()
        pair = cloud_pair(case.scene_samples, case.object_samples, self.normalized)
        matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel_size=pair.voxel))
        found = matcher.estimate(list(pair.scene.astype(np.float32)), list(pair.object.astype(np.float32)))
        seconds = time.perf_counter() - begun
        if not found.valid:
            raise InitializationError("KISS-Matcher calls its own solution invalid")
        matrix = np.eye(4)
        matrix[:3, :3] = np.asarray(found.rotation, dtype=np.float64)
        matrix[:3, 3] = np.asarray(found.translation, dtype=np.float64).ravel()
        note = f"{matcher.get_num_final_inliers()} inliers"
        return PeerResult(pair.to_object_scene(matrix), seconds, note=note)
