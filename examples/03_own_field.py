"""A field of your own: anything with signed distances, gradients and bounds can be registered.

Registers a chair of boxes, given by formula, onto a smaller, turned copy of itself.

python examples/03_own_field.py
"""

import sys
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core import OrientedBox, Sim3, register

if len(sys.argv) > 1:
    sys.exit(f"usage: {__doc__}")
SEAT, BACK, ARM = (
    ([0, 0, 0], [0.5, 0.5, 0.1]),
    ([-0.2, 0, 0.25], [0.1, 0.5, 0.5]),
    ([0.05, 0.22, 0.12], [0.4, 0.06, 0.25]),
)


@dataclass(frozen=True)
class BoxesField:
    """The union of axis-aligned boxes (center, full size), seen from a frame that ``T_own_frame`` maps to theirs."""

    T_own_frame: Sim3
    bounds: Tensor

    device = torch.device("cpu")

    def to(self, device: torch.device | str) -> "BoxesField":
        return self

    def signed_distance(self, points: Tensor) -> Tensor:
        own = self.T_own_frame.apply(points.double())
        distances = []
        for center, size in (SEAT, BACK, ARM):
            gap = (own - torch.tensor(center)).abs() - torch.tensor(size) / 2
            distances.append(gap.clamp(min=0).norm(dim=-1) + gap.amax(dim=-1).clamp(max=0))
        return (torch.stack(distances).amin(dim=0) / self.T_own_frame.scale).float()

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            asked = points.detach().clone().requires_grad_()
            distance = self.signed_distance(asked)
            (gradient,) = torch.autograd.grad(distance.sum(), asked)
        return distance.detach(), gradient


cube = torch.tensor([[-1.0] * 3, [1.0] * 3], dtype=torch.float64)
T_object_scene = Sim3.exp(torch.tensor([0.0, 0.0, 0.4, 0.05, -0.08, 0.02, 0.2], dtype=torch.float64))
chair = BoxesField(Sim3.identity(), cube)
scene = BoxesField(T_object_scene, cube)

result = register(scene, chair, OrientedBox.from_corners([-0.4, -0.4, -0.3], [0.4, 0.4, 0.6]))
print(result.verdict, result.verdict_reason)
print("found\n", result.T_object_scene.matrix())
print("true\n", T_object_scene.matrix())
