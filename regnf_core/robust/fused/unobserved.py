"""What was not observed of one scene, for the poses of several pairs: each in the working frame of its detection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.robust.fused.parts import Part
from regnf_core.robust.scene import SingleView
from regnf_core.robust.working_frame import UnobservedTest, VoxelStates, WorkingObservation

Stacked = VoxelStates | SingleView
"""Of P pairs: with one more dimension in front."""
_OF_FRAMES = ("turn", "shift", "clearance")
"""What differs where the same voxels are looked up in several frames."""


def stacked_tests(tests: Sequence[UnobservedTest | None], device: torch.device) -> Stacked | None:
    """The tests of pairs of one kind as one; None where all was observed."""
    views = [one for one in tests if isinstance(one, SingleView)]
    if views:
        return SingleView(torch.stack([one.viewpoint for one in views]).to(device))
    seen = [one.on(device) for one in tests if isinstance(one, WorkingObservation)]
    if not seen:
        return None
    turn, shift, clearance = (torch.stack([getattr(one, name) for one in seen]) for name in _OF_FRAMES)
    return replace(seen[0], turn=turn, shift=shift, clearance=clearance)


def of_part(stacked: Stacked, part: Part) -> UnobservedTest:
    """The test for points (H N, 3), N of each pose of the part."""
    if isinstance(stacked, SingleView):
        return _OfPoses(SingleView(stacked.viewpoint[part.pairs][:, None]), len(part.pairs))
    turn, shift, clearance = (getattr(stacked, name)[part.pairs] for name in _OF_FRAMES)
    return _OfPoses(replace(stacked, turn=turn, shift=shift, clearance=clearance), len(part.pairs))


@dataclass(frozen=True, eq=False)
class _OfPoses:
    """A test whose frames are those of ``count`` poses."""

    test: Stacked
    count: int

    def unobserved(self, points: Tensor, values: Tensor) -> Tensor:
        """See :class:`UnobservedTest`."""
        if isinstance(self.test, SingleView):
            return self.test.unobserved(points, values)
        return self.test.unobserved(self._apart(points), values.reshape(self.count, -1)).reshape(-1)

    def faces_unobserved(self, points: Tensor, normals: Tensor) -> Tensor:
        """See :class:`UnobservedTest`."""
        asked = self._apart(points), self._apart(normals)
        test = self.test
        found = test.faces_unobserved(*asked) if isinstance(test, SingleView) else test.facing_unseen(*asked)
        return found.reshape(-1)

    def to(self, device: torch.device | str) -> _OfPoses:
        """The same for points on another device."""
        return _OfPoses(self.test.to(torch.device(device)), self.count)

    def _apart(self, rows: Tensor) -> Tensor:
        """(H N, 3) as (H, N, 3)."""
        return rows.reshape(self.count, -1, 3)
