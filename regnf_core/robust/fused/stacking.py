"""The surfaces of several pairs as one pair of surfaces for the poses of a part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.robust.fused.models import PartModel, Stack, stack_of
from regnf_core.robust.fused.parts import Part
from regnf_core.robust.fused.unobserved import Stacked, of_part, stacked_tests
from regnf_core.robust.residuals import SurfacePair
from regnf_core.robust.working_frame import Samples


def kind_of(pair: SurfacePair) -> str:
    """Pairs of one kind can be stacked: what tells where their scenes were not observed is the same."""
    return type(pair.scene_samples.unobserved).__name__


@dataclass(frozen=True, eq=False)
class StackedSurfaces:
    """Models and samples of P pairs; points (P, N, 3), N for all of them. unobserved: what was not observed of the
    scene; None: all of it was."""

    scene: Stack
    obj: Stack
    scene_samples: Samples
    object_samples: Samples
    unobserved: Stacked | None = None

    @classmethod
    def of(cls, pairs: Sequence[SurfacePair], points: int) -> StackedSurfaces:
        """Surfaces of one kind with at most ``points`` samples each. Where there are fewer, the last is repeated, and
        counts once."""
        tests = [one.scene_samples.unobserved for one in pairs]
        device = pairs[0].scene_samples.points.device
        return cls(
            stack_of([one.scene for one in pairs], device),
            stack_of([one.obj for one in pairs], device),
            _stacked([one.scene_samples for one in pairs], points),
            _stacked([one.object_samples for one in pairs], points),
            stacked_tests(tests, device),
        )

    def of_part(self, part: Part) -> PartSurfaces:
        """The surfaces for each pose of the part: samples (H, N, 3)."""
        A, B = (samples[part.pairs] for samples in (self.scene_samples, self.object_samples))
        if self.unobserved is not None:
            A = replace(A, unobserved=of_part(self.unobserved, part))
        scene, obj = self.scene.model_of(part), self.obj.model_of(part)
        return PartSurfaces(SurfacePair(scene, obj, A, B), (scene, obj))


@dataclass(frozen=True, eq=False)
class PartSurfaces:
    """The surfaces for the poses of a part; its models are the pair's."""

    pair: SurfacePair
    models: tuple[PartModel, PartModel]

    def faulty(self) -> Tensor:
        """(H,) bool: which poses met a value that is not finite."""
        poses = self.pair.scene_samples.points[:, 0, 0]
        found = torch.zeros_like(poses, dtype=torch.bool)
        for model in self.models:
            found = found if model.faulty is None else found | model.faulty
        return found


def _stacked(parts: Sequence[Samples], points: int) -> Samples:
    """Samples (P, N, 3), all with shares."""
    rows = [torch.arange(points, device=one.points.device).clamp_max(len(one) - 1) for one in parts]
    filled = [one[row] for one, row in zip(parts, rows, strict=True)]
    counts = torch.tensor([[len(one)] for one in parts], device=rows[0].device)
    shares = (torch.arange(points, device=rows[0].device) < counts).float() / counts
    hidden = [one.hidden for one in filled if one.hidden is not None]
    return Samples(
        torch.stack([one.points for one in filled]),
        torch.stack([one.values for one in filled]),
        torch.stack([one.normals for one in filled]),
        parts[0].unobserved,
        shares,
        torch.stack(hidden) if len(hidden) == len(parts) else None,
    )
