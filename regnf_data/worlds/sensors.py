"""Depth cameras drawn at random: structured light, time of flight, stereo; what each misses and how it errs.

And the camera of simulated datasets, which errs little or not at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from regnf_data.rendering import Size, intrinsics_of
from regnf_data.sensor import jumps
from regnf_data.worlds.exact import ExactView
from regnf_data.worlds.mesh import Array

Principle = Literal["structured light", "time of flight", "stereo", "rendered"]
PRINCIPLES: tuple[Principle, ...] = ("structured light", "time of flight", "stereo")
SIZES: tuple[Size, ...] = ((120, 160), (240, 320), (480, 640))
_SIZE_SHARES = (0.3, 0.55, 0.15)
PLAIN, BLACK, GLOSSY = 0, 1, 2
_MATTER_SHARES = (0.82, 0.1, 0.08)
_EDGE_M = 0.04


@dataclass(frozen=True)
class RandomSensor:
    """A depth camera. noise: deviation at depth z is noise[0] + noise[1] z + noise[2] z^2 meters.

    step: readings are multiples of step z^2 (parallax) or of step (time of flight, rendered) · grain: over how many
    pixels of an image 640 wide errors are alike · edge_loss: share of the readings lost at jumps · mixed: share of
    those at jumps that lie between both sides · black_loss, glossy_loss: shares of the readings lost on such surfaces.
    """

    principle: Principle
    size: Size
    field_of_view_deg: float
    nearest_m: float
    farthest_m: float
    noise: tuple[float, float, float]
    step: float
    grain: float
    edge_loss: float
    mixed: float
    black_loss: float
    glossy_loss: float
    grazing_deg: float

    @property
    def intrinsics(self) -> Array:
        """(3, 3)."""
        return intrinsics_of(self.size, self.field_of_view_deg)

    def deviation_m(self, depth: Array) -> Array:
        """Of readings at depths in meters."""
        level, linear, square = self.noise
        spread: Array = level + linear * depth + square * depth**2
        return spread

    def measure(self, view: ExactView, matter: NDArray[np.int64], rng: np.random.Generator) -> Array:
        """(H, W) meters, 0 where nothing is read. matter: of each thing, PLAIN, BLACK or GLOSSY."""
        exact, shape = view.depth, view.depth.shape
        edge = jumps(exact, _EDGE_M)
        of_pixel = np.where(view.thing >= 0, matter[view.thing], PLAIN)
        loss = np.where(edge, self.edge_loss, 0.0)
        loss = np.maximum(loss, np.where(of_pixel == BLACK, self.black_loss, 0.0))
        # Glossy surfaces fail in patches, and where they mirror the lamp beside the camera.
        patches = ndimage.gaussian_filter(rng.normal(size=shape), shape[1] / 40.0)
        glossy = (patches > 0.0) | (view.cosine > 0.97)
        loss = np.maximum(loss, np.where((of_pixel == GLOSSY) & glossy, self.glossy_loss, 0.0))
        lost = (rng.random(shape) < loss) | (view.cosine < np.cos(np.radians(self.grazing_deg))) | (exact <= 0.0)
        # Only where both sides are: nothing lies between a surface and no reading.
        between = edge & (ndimage.minimum_filter(exact, 3) > 0.0) & (rng.random(shape) < self.mixed)
        seen = np.where(between, ndimage.uniform_filter(exact, 3), exact)
        read = seen + self.deviation_m(seen) * self._grainy(shape, rng)
        read = self._rounded(read)
        lost |= (read < self.nearest_m) | (read > self.farthest_m)
        return np.where(lost, 0.0, read)

    def _grainy(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        """Errors of deviation 1, alike over ``grain`` pixels."""
        white = rng.normal(size=shape)
        width = self.grain * shape[1] / 640.0
        if width < 0.3:
            return white
        smooth = ndimage.gaussian_filter(white, width)
        grainy: Array = smooth / smooth.std()
        return grainy

    def _rounded(self, read: Array) -> Array:
        if self.step <= 0.0:
            return read
        if self.principle in ("time of flight", "rendered"):
            return np.asarray(np.round(read / self.step) * self.step)
        inverse = np.divide(1.0, read, out=np.zeros_like(read), where=read > 0.05)
        steps = np.round(inverse / self.step) * self.step
        return np.divide(1.0, steps, out=np.zeros_like(read), where=steps > 0.0)


def draw_sensor(rng: np.random.Generator, size: Size | None = None) -> RandomSensor:
    """A camera of the kinds that are sold. size: instead of a random one."""
    principle = PRINCIPLES[int(rng.choice(3, p=(0.45, 0.3, 0.25)))]
    size = size or SIZES[int(rng.choice(3, p=_SIZE_SHARES))]
    loss = {"edge_loss": rng.uniform(0.1, 0.6), "grazing_deg": rng.uniform(72.0, 85.0)}
    loss |= {"black_loss": rng.uniform(0.2, 0.95), "glossy_loss": rng.uniform(0.2, 0.9)}
    if principle == "structured light":
        # Nguyen, Izadi and Lovell (2012) for the first Kinect, a little better to somewhat worse.
        noise = (rng.uniform(0.0006, 0.0015), 0.0, rng.uniform(0.0008, 0.0028))
        angles, reach, step, grain, mixed = (55.0, 62.0), (0.35, 5.0), rng.uniform(0.0008, 0.003), 1.2, 0.0
    elif principle == "time of flight":
        noise = (rng.uniform(0.001, 0.003), rng.uniform(0.0005, 0.002), rng.uniform(0.0, 0.0008))
        angles, reach, step, grain, mixed = (62.0, 76.0), (0.2, 5.0), 0.001, 0.5, rng.uniform(0.03, 0.25)
    else:
        noise = (rng.uniform(0.0003, 0.001), 0.0, rng.uniform(0.001, 0.004))
        angles, reach, step, grain, mixed = (
            (65.0, 88.0),
            (0.25, 6.0),
            rng.uniform(0.0003, 0.002),
            3.5,
            rng.uniform(0.1, 0.4),
        )
    return RandomSensor(
        principle, size, rng.uniform(*angles), reach[0], reach[1], noise, step, grain, mixed=mixed, **loss
    )


def rendered_sensor(rng: np.random.Generator, size: Size | None = None) -> RandomSensor:
    """The camera of a simulated dataset: exact, or with the errors of ``regnf_data.sensor.DepthSensor``.

    It misses no matter. size: instead of a random one.
    """
    size = size or SIZES[int(rng.choice(3, p=_SIZE_SHARES))]
    field_of_view, exact = rng.uniform(55.0, 75.0), rng.random() < 0.5
    # .0012 + .0019 (z - .4)^2, multiplied out.
    noise = (0.0, 0.0, 0.0) if exact else (0.001504, -0.00152, 0.0019)
    step, edge_loss, grazing_deg = (0.0, 0.0, 90.0) if exact else (0.001, 0.2, 80.0)
    return RandomSensor(
        "rendered", size, field_of_view, 0.05, 9.0, noise, step, 0.0, edge_loss, 0.0, 0.0, 0.0, grazing_deg
    )


def draw_matter(count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """(count,): PLAIN, BLACK or GLOSSY for each thing."""
    return np.asarray(rng.choice((PLAIN, BLACK, GLOSSY), size=count, p=_MATTER_SHARES), dtype=np.int64)
