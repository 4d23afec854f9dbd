"""The errors of a depth camera that projects light (structured light, time of flight)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_NGUYEN_WIDTH = 640
"""Pixels across the images that the lateral error was measured in."""


@dataclass(frozen=True)
class DepthSensor:
    """Depth noise. Axial and lateral errors by Nguyen, Izadi and Lovell (2012) for the first Kinect.

    "Modeling Kinect sensor noise for improved 3D reconstruction and tracking", 3DIMPVT 2012: the axial deviation at
    depth z is .0012 + .0019 (z - .4)^2 meters, the lateral one .8 pixels of an image 640 wide. Their further terms
    for surfaces seen at more than 60 degrees are left out; beyond ``grazing_deg`` readings are lost instead.
    """

    nearest_m: float = 0.4
    farthest_m: float = 5.0
    step_m: float = 0.001
    """Readings are whole multiples of this."""
    lateral_pixels: float = 0.8
    grazing_deg: float = 80.0
    """Surfaces seen at a larger angle from their normal give no reading."""
    edge_jump_m: float = 0.05
    edge_dropout: float = 0.2
    """The share of readings lost where the depth jumps by ``edge_jump_m`` or more; a choice, for small images."""

    def deviation_m(self, depth_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviation of the axial error at depths in meters."""
        return 0.0012 + 0.0019 * (depth_m - 0.4) ** 2

    def measure(
        self, exact: NDArray[np.float64], cosine: NDArray[np.float64], rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """What the sensor reads of an exact depth image (H, W), 0 where it reads nothing; meters.

        cosine: (H, W), between the ray and the surface's normal.
        """
        lost = cosine < np.cos(np.radians(self.grazing_deg))
        lost |= jumps(exact, self.edge_jump_m) & (rng.random(exact.shape) < self.edge_dropout)
        seen = self._sideways(exact, rng)
        read = seen + self.deviation_m(seen) * rng.normal(size=exact.shape)
        read = np.round(read / self.step_m) * self.step_m
        lost |= (exact <= 0.0) | (seen <= 0.0) | (read < self.nearest_m) | (read > self.farthest_m)
        return np.where(lost, 0.0, read)

    def _sideways(self, depth: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Every pixel's depth taken from a neighbor that lies as far as the lateral error says, mostly itself."""
        height, width = depth.shape
        shift = rng.normal(scale=self.lateral_pixels * width / _NGUYEN_WIDTH, size=(2, height, width))
        rows, columns = np.indices(depth.shape) + np.round(shift).astype(np.int64)
        shifted: NDArray[np.float64] = depth[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
        return shifted


def jumps(depth: NDArray[np.float64], jump: float) -> NDArray[np.bool_]:
    """(H, W): pixels whose depth (H, W) is off by ``jump`` or more from the plane through its neighbors on two sides.

    On a plane, however slanted, 1 / z is linear in the pixels: only edges and the background (0) count.
    """
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0.0)
    bend = np.zeros_like(depth)
    bend[1:-1] = np.abs(inverse[:-2] + inverse[2:] - 2.0 * inverse[1:-1])
    bend[:, 1:-1] = np.maximum(bend[:, 1:-1], np.abs(inverse[:, :-2] + inverse[:, 2:] - 2.0 * inverse[:, 1:-1]))
    return np.asarray(bend * depth**2 >= jump)
