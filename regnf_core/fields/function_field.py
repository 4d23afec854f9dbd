"""A function of points as an SdfField: no autograd graph, in chunks, on the device of its parameters."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Generic, Protocol, Self, TypeVar

import torch
from torch import Tensor

_CHUNK = 1 << 10  # the layers' outputs at so many points fit a core's own cache
_CHUNK_ACCELERATOR = 1 << 18


class SdfFunction(Protocol):
    """What a kind of field has to write: the distance, its gradient in closed form, and a move to another device."""

    @property
    def device(self) -> torch.device:
        """Where the parameters live."""
        ...

    def to(self, device: torch.device | str) -> Self:
        """The same function with its parameters on another device."""
        ...

    def value(self, points: Tensor) -> Tensor:
        """Signed distance (N,) at points (N, 3) float32, both on ``device``."""
        ...

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) at points (N, 3) and its gradient (N, 3) with respect to them."""
        ...


F = TypeVar("F", bound=SdfFunction)


class FunctionField(Generic[F]):
    """An :class:`SdfFunction` as an SdfField.

    bounds: (2, 3), lowest and highest corner of the region where the field has meaning, own frame.
    chunk: points evaluated at once; None picks what suits the device (CPU: what fits its cache).
    """

    def __init__(self, function: F, bounds: Tensor, chunk: int | None = None) -> None:
        self.function = function
        self.chunk = chunk
        self._bounds = torch.as_tensor(bounds, dtype=torch.float64, device="cpu")

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float64 on the CPU, own frame."""
        return self._bounds

    @property
    def device(self) -> torch.device:
        """Where the parameters live."""
        return self.function.device

    def to(self, device: torch.device | str) -> Self:
        """The same field with its parameters on another device."""
        return type(self)(self.function.to(device), self._bounds, self.chunk)

    @torch.no_grad()
    def signed_distance(self, points: Tensor) -> Tensor:
        """Signed distance (N,) float32 at points (N, 3)."""
        distance = self._empty(len(points))
        for at, part in self._chunks(points):
            distance[at] = self.function.value(part)
        return distance

    @torch.no_grad()
    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) and its gradient (N, 3) at points (N, 3)."""
        distance, gradient = self._empty(len(points)), self._empty(len(points), 3)
        for at, part in self._chunks(points):
            distance[at], gradient[at] = self.function.value_and_gradient(part)
        return distance, gradient

    def _empty(self, *shape: int) -> Tensor:
        """For the results: a chunk's own may be a view that keeps all of the last layer's output."""
        return torch.empty(shape, dtype=torch.float32, device=self.device)

    def _chunks(self, points: Tensor) -> Iterator[tuple[slice, Tensor]]:
        """Where each chunk lies, and its points."""
        size = self.chunk or (_CHUNK if self.device.type == "cpu" else _CHUNK_ACCELERATOR)
        points = points.to(device=self.device, dtype=torch.float32)
        for start in range(0, len(points), size):
            at = slice(start, start + size)
            yield at, points[at]
