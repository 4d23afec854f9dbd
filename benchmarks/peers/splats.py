"""splatreg: Sim(3) registration of Gaussian splats, from its package, on the CPU."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from benchmarks.peers.clouds import CloudPair, cloud_pair
from benchmarks.peers.interface import MissingPackageError, PeerCase, PeerResult

_MOST = 2000  # splats a side: its global search is quadratic in them
_FLATNESS = 0.1


@dataclass(frozen=True)
class Splatreg:
    """The surface points as flat splats, ``transform="sim3"``, the coarse search named by ``start``.

    A splat lies at every point (at most 2000 a side, drawn by the seed), its short axis along the normal, as wide as
    the points lie apart.
    """

    start: str
    normalized: bool = False
    uses_samples: bool = True

    @property
    def name(self) -> str:
        return f"splatreg {self.start}" + " normalized" * self.normalized

    @property
    def given(self) -> str:
        size = ", both clouds scaled to the same root mean square radius" if self.normalized else ""
        return f"exact normals{size}"

    def register(self, case: PeerCase, seed: int) -> PeerResult:
        """Raises InitializationError for a transform that is none; MissingPackageError."""
        try:
            import splatreg
        except ImportError as error:
            raise MissingPackageError("splatreg") from error

        begun = time.perf_counter()
        pair = cloud_pair(case.scene_samples, case.object_samples, self.normalized)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            scene, obj = _splats(splatreg, pair, "scene"), _splats(splatreg, pair, "object")
            found = splatreg.register(obj, scene, init=self.start, transform="sim3")
        T = pair.to_object_scene(found.T.detach().double().cpu().numpy())
        note = "converged" if found.converged else "not converged"
        return PeerResult(T, time.perf_counter() - begun, note=note)


def _splats(splatreg: Any, pair: CloudPair, side: str) -> Any:
    points = torch.from_numpy(getattr(pair, side)).float()
    normals = torch.from_numpy(getattr(pair, f"{side}_normals")).float()
    chosen = torch.randperm(len(points))[:_MOST]
    points, normals = points[chosen], normals[chosen]
    apart = torch.from_numpy(cKDTree(points.numpy()).query(points.numpy(), k=2)[0][:, 1]).float().median()
    widths = apart * torch.tensor([1.0, 1.0, _FLATNESS])
    return splatreg.Gaussians(points, _turn_z_to(normals), widths.expand(len(points), 3), torch.ones(len(points)))


def _turn_z_to(normals: Tensor) -> Tensor:
    """Unit quaternions (N, 4), wxyz, of the shortest turns that carry z onto unit vectors (N, 3)."""
    x, y, z = normals.unbind(-1)
    quaternion = torch.stack([1.0 + z, -y, x, torch.zeros_like(z)], dim=-1)
    half_turn = torch.tensor([0.0, 1.0, 0.0, 0.0])
    quaternion = torch.where((1.0 + z < 1e-6)[:, None], half_turn, quaternion)
    return quaternion / quaternion.norm(dim=-1, keepdim=True)
