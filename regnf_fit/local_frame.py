"""The frame that a field is fitted in, where its world is too far or too large for it.

A hash grid covers [-2, 2]^3, and numbers of single precision at a map's coordinates, half a million meters from its
origin, are centimeters apart. What is made keeps how it lies in the world.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from regnf_data.posed_images import PosedImages

_REACH = 1.9
"""Of the bounds from their middle, in a hash grid that ends at 2."""
_FAR = 100.0
"""Diagonals of the bounds from the origin, beyond which a map is made about an origin of its own."""


@dataclass(frozen=True, eq=False)
class LocalFrame:
    """x' = scale (x - origin), origin (3,) and bounds (2, 3) in the world."""

    origin: NDArray[np.float64]
    scale: float
    bounds: NDArray[np.float64]

    @classmethod
    def in_grid(cls, bounds: NDArray[np.float64], radius: float) -> LocalFrame:
        """Of bounds that shall lie within [-radius, radius]^3: their own where they do."""
        if np.abs(bounds).max() <= radius:
            return cls(np.zeros(3), 1.0, bounds)
        half = float((bounds[1] - bounds[0]).max()) / 2.0
        return cls(bounds.mean(axis=0), min(1.0, _REACH / half), bounds)

    @classmethod
    def near_origin(cls, bounds: NDArray[np.float64]) -> LocalFrame:
        """Of bounds that shall not lie far from the origin, of the world's own unit."""
        far = np.abs(bounds).max() > _FAR * np.linalg.norm(bounds[1] - bounds[0])
        return cls(np.round(bounds.mean(axis=0)) if far else np.zeros(3), 1.0, bounds)

    @property
    def same(self) -> bool:
        """Whether it is the world itself."""
        return self.scale == 1.0 and not self.origin.any()

    @property
    def T_world_local(self) -> NDArray[np.float64]:
        """(4, 4)."""
        T = np.diag([1.0 / self.scale] * 3 + [1.0])
        T[:3, 3] = self.origin
        return T

    def enter(self, images: PosedImages) -> PosedImages:
        return images if self.same else images.moved(self.origin, self.scale)

    def leave(self, description: dict[str, Any]) -> dict[str, Any]:
        """The description of a field that was made in this frame, as it lies in the world."""
        if self.same:
            return description
        placement = {"transform": self.T_world_local.tolist(), "bounds": description["bounds"]}
        outside = np.asarray(description["bounds"], np.float64) / self.scale + self.origin
        return {**description, "placement": placement, "bounds": outside.tolist()}
