"""Samples of both surfaces.

The package's docstring explains the sources.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SamplingConstants:
    """Samples of both surfaces (sampling.py)."""

    box_growth: float = 1.2
    """Factor. The scene is sampled in the detection box grown by this: boxes are often too small or off center. [by
    hand]"""
    object_base: int = 8
    """Cells along the longest edge of the object's first grid. [by hand]"""
    scene_base: int = 9
    """The same for the scene. [by hand]"""
    levels: int = 2
    """How often a cell near the surface is divided by two along each axis. [by hand]"""
    max_cell_distance: float = 0.6
    """Cell edges from the surface. Cells farther off find the same points as their neighbors. [by hand]"""
    max_sample_distance: float = 0.35
    """Cell edges from the surface. A sample that is farther off after its Newton step is dropped. [by hand]"""
    min_slope: float = 0.2
    """Length of the gradient. A Newton step along a shorter one leads nowhere: true distances have 1. [by hand]"""
    cloud_margin: float = 0.05
    """Share of the box's size. Points of a result's clouds may lie so far outside of the box. [by hand]"""


SAMPLING = SamplingConstants()
