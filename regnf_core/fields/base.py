"""What every field offers, whatever made it: signed distance, its gradient, its bounds."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from regnf_core.labels import shown_number


@runtime_checkable
class SdfField(Protocol):
    """A signed distance field: positive in free space, negative inside matter, in units of its own frame.

    Implementations evaluate without building an autograd graph, in chunks that bound memory, in float32, on ``device``.
    Use :func:`differentiable_signed_distance` where a loss must flow back to the points.
    """

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float64 on the CPU: lowest and highest corner of the region where the field has meaning, own frame."""
        ...

    @property
    def device(self) -> torch.device:
        """Where the field's parameters live; points are moved there."""
        ...

    def to(self, device: torch.device | str) -> SdfField:
        """The same field with its parameters on another device."""
        ...

    def signed_distance(self, points: Tensor) -> Tensor:
        """Signed distance (N,) float32 at points (N, 3) in the field's frame."""
        ...

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) and its gradient (N, 3) with respect to the points (N, 3)."""
        ...


def field_repr(field: SdfField) -> str:
    """A field in a line: its class, and where it has meaning."""
    low, high = (f"[{', '.join(map(shown_number, corner.tolist()))}]" for corner in field.bounds)
    return f"<{type(field).__name__}, bounds {low} to {high}, {field.device}>"


class _SignedDistance(torch.autograd.Function):
    """Signed distance whose backward pass uses the field's own gradient: no graph through the network is kept."""

    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, points: Tensor, field: SdfField) -> Tensor:
        distance, gradient = field.signed_distance_and_gradient(points.detach())
        ctx.save_for_backward(gradient)
        return distance.to(points)

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        (gradient,) = ctx.saved_tensors  # type: ignore[attr-defined]
        return grad_outputs[0].unsqueeze(-1) * gradient.to(grad_outputs[0]), None


def differentiable_signed_distance(field: SdfField, points: Tensor) -> Tensor:
    """Signed distance (N,) at points (N, 3) that autograd can differentiate once with respect to the points."""
    return _SignedDistance.apply(points, field)  # type: ignore[no-untyped-call, no-any-return]
