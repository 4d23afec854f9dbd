"""What the caller knows of the scale: the scale factors that a pose may have."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RobustOptions


@dataclass(frozen=True)
class ScaleBound:
    """The scales s of poses x -> s R x + t between two frames: low <= s <= high; 0 and infinite: not known."""

    low: float = 0.0
    high: float = math.inf

    @classmethod
    def of(cls, options: RobustOptions, scene_length: float, object_length: float) -> ScaleBound:
        """The options' bound between the working frames. lengths: of the working frames' units, fields' units."""
        unit = scene_length / object_length
        low, high = options.min_scale, options.max_scale
        return cls(0.0 if low is None else low * unit, math.inf if high is None else high * unit)

    @property
    def is_open(self) -> bool:
        """Whether every scale is allowed."""
        return self.low == 0.0 and self.high == math.inf

    @property
    def log_width(self) -> float:
        """The logarithm of the largest scale that is allowed over the smallest."""
        return math.log(self.high / self.low) if self.low > 0.0 else math.inf

    def limited(self, scale: Tensor) -> Tensor:
        """The nearest scales that are allowed."""
        return scale.clamp(self.low, self.high)

    def limited_growth(self, scale: Tensor, growth: Tensor) -> Tensor:
        """The changes of log ``scale`` (H,), an allowed one, nearest to ``growth`` (H,) that lead to an allowed one."""
        low, high = (torch.full_like(scale, end) for end in (self.low, self.high))
        return ScaleBounds(low, high).limited_growth(scale, growth)

    def limited_poses(self, T: Sim3) -> Sim3:
        """Poses T (H,) with the nearest allowed scales; the object's center, 0, stays where it is in the scene."""
        if self.is_open:
            return T
        scale = self.limited(T.scale)
        return replace(T, scale=scale, translation=T.translation * (scale / T.scale)[..., None])


@dataclass(frozen=True, eq=False)
class ScaleBounds:
    """A bound for each pose of a batch: low, high (H,)."""

    low: Tensor
    high: Tensor
    is_open = False

    @classmethod
    def same(cls, T: Sim3) -> ScaleBounds:
        """Of poses T (H,) that keep their scales."""
        return cls(T.scale, T.scale)

    def limited_growth(self, scale: Tensor, growth: Tensor) -> Tensor:
        """As that of :class:`ScaleBound`."""
        low, high = ((end / scale).log() for end in (self.low, self.high))
        return torch.minimum(torch.maximum(growth, low), high)


ANY_SCALE = ScaleBound()
SAME_SCALE = ScaleBound(1.0, 1.0)
