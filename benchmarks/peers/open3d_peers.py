"""FPFH features (Rusu et al. 2009) with fast global registration (Zhou et al. 2016) or RANSAC and ICP, from open3d."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from benchmarks.peers.clouds import VOXEL, CloudPair, cloud_pair, described
from benchmarks.peers.interface import PeerCase, PeerResult
from regnf_core.errors import InitializationError

_RANSAC_DISTANCE, _EDGE_RATIO, _RANSAC_POINTS = 1.5, 0.9, 4  # voxels; Reg-NF's values
_RANSAC_ITERATIONS, _CONFIDENCE = 100_000, 0.999
_FGR_DISTANCE = 0.5  # voxels, as in open3d's tutorial
_ICP_DISTANCES = (1.5, 0.4)  # voxels: coarse, then Reg-NF's


@dataclass(frozen=True)
class FastGlobalRegistration:
    """FGR on FPFH features. It has no scale: ``normalized`` clouds lend it the ratio of their sizes."""

    normalized: bool
    uses_samples: bool = True

    @property
    def name(self) -> str:
        return "fgr normalized" if self.normalized else "fgr"

    @property
    def given(self) -> str:
        return "exact normals" + _SIZE * self.normalized

    def register(self, case: PeerCase, seed: int) -> PeerResult:
        """Raises InitializationError where the clouds are too small or no transform is found."""
        from open3d.pipelines import registration

        begun = time.perf_counter()
        pair = cloud_pair(case.scene_samples, case.object_samples, self.normalized)
        scene, obj = _features(pair, seed)
        found = registration.registration_fgr_based_on_feature_matching(
            scene[0],
            obj[0],
            scene[1],
            obj[1],
            registration.FastGlobalRegistrationOption(maximum_correspondence_distance=_FGR_DISTANCE * pair.voxel),
        )
        T = pair.to_object_scene(found.transformation)
        return PeerResult(T, time.perf_counter() - begun, note=f"{len(found.correspondence_set)} matches")


@dataclass(frozen=True)
class RansacIcp:
    """RANSAC over mutual FPFH matches, then ICP.

    Without ``scaled``: rigid, then point-to-plane. With it: a similarity from RANSAC and point-to-point ICP alike, and
    no check of edge lengths, which would forbid a change of scale.
    """

    normalized: bool
    scaled: bool
    uses_samples: bool = True
    voxel: float = VOXEL

    @property
    def name(self) -> str:
        return "ransac_icp" + " normalized" * self.normalized + " scaled" * self.scaled

    @property
    def given(self) -> str:
        return "exact normals" + _SIZE * self.normalized

    def register(self, case: PeerCase, seed: int) -> PeerResult:
        """Raises InitializationError where the clouds are too small or no match survives."""
        from open3d.pipelines import registration

        begun = time.perf_counter()
        pair = cloud_pair(case.scene_samples, case.object_samples, self.normalized, self.voxel)
        scene, obj = _features(pair, seed)
        matched = self._ransac(scene, obj, pair.voxel)
        if len(matched.correspondence_set) == 0:
            raise InitializationError("feature matching found no transform between the two surfaces")
        T = matched.transformation
        estimation = (
            registration.TransformationEstimationPointToPoint(with_scaling=True)
            if self.scaled
            else registration.TransformationEstimationPointToPlane()
        )
        for reach in _ICP_DISTANCES:
            refined = registration.registration_icp(scene[0], obj[0], reach * pair.voxel, T, estimation)
            T = refined.transformation
        note = f"fitness {refined.fitness:.2f}"
        return PeerResult(pair.to_object_scene(T), time.perf_counter() - begun, note=note)

    def _ransac(self, scene: tuple[Any, Any], obj: tuple[Any, Any], voxel: float) -> Any:
        from open3d.pipelines import registration

        distance = _RANSAC_DISTANCE * voxel
        checks: list[Any] = [registration.CorrespondenceCheckerBasedOnDistance(distance)]
        if not self.scaled:
            checks.insert(0, registration.CorrespondenceCheckerBasedOnEdgeLength(_EDGE_RATIO))
        return registration.registration_ransac_based_on_feature_matching(
            scene[0],
            obj[0],
            scene[1],
            obj[1],
            mutual_filter=True,
            max_correspondence_distance=distance,
            estimation_method=registration.TransformationEstimationPointToPoint(with_scaling=self.scaled),
            ransac_n=_RANSAC_POINTS,
            checkers=checks,
            criteria=registration.RANSACConvergenceCriteria(_RANSAC_ITERATIONS, _CONFIDENCE),
        )


_SIZE = ", both clouds scaled to the same root mean square radius"


def _features(pair: CloudPair, seed: int) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Both described clouds, with open3d's random numbers set to start from the seed and its warnings silenced."""
    import open3d

    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    open3d.utility.random.seed(seed % 2**31)
    scene = described(pair.scene, pair.scene_normals, pair.voxel)
    return scene, described(pair.object, pair.object_normals, pair.voxel)
