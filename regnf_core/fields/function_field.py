"""A function of points as an SdfField: no autograd graph, in chunks, on the device of its parameters."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Generic, Protocol, Self, TypeVar, runtime_checkable

import torch
from torch import Tensor

from regnf_core.fields.base import field_repr
from regnf_core.fields.color import ColorFunction

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


class Evaluator(Protocol):
    """What evaluates a function's present parameters, without a graph."""

    def value(self, points: Tensor) -> Tensor:
        """As :meth:`SdfFunction.value`."""
        ...

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """As :meth:`SdfFunction.value_and_gradient`."""
        ...


@runtime_checkable
class ColoredFunction(Protocol):
    """A function that may have color."""

    @property
    def has_color(self) -> bool:
        """Whether :meth:`color` may be asked."""
        ...

    def color(self, points: Tensor, directions: Tensor) -> Tensor:
        """Color (N, 3) in [0, 1] at points (N, 3) along unit directions (N, 3), all float32 and on one device."""
        ...


F = TypeVar("F", bound=SdfFunction)


class FunctionField(Generic[F]):
    """An :class:`SdfFunction` as an SdfField.

    bounds: (2, 3), lowest and highest corner of the region where the field has meaning, own frame.
    chunk: points evaluated at once; None picks what suits the device (CPU: what fits its cache) · inverse_deviation:
    NeuS's s, per unit of the own frame, if it is known.
    """

    color: ColorFunction
    """Only where the function has color."""

    def __init__(
        self, function: F, bounds: Tensor, chunk: int | None = None, inverse_deviation: float | None = None
    ) -> None:
        self.function = function
        self.chunk = chunk
        self.inverse_deviation = inverse_deviation
        if isinstance(function, ColoredFunction) and function.has_color:
            self.color = partial(_chunked_color, function, chunk, function.device)
        self._bounds = torch.as_tensor(bounds, dtype=torch.float64, device="cpu")

    def __repr__(self) -> str:
        return field_repr(self)

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
        return type(self)(self.function.to(device), self._bounds, self.chunk, self.inverse_deviation)

    def with_inverse_deviation(self, inverse_deviation: float | None) -> Self:
        """The same field with another inverse deviation."""
        return type(self)(self.function, self._bounds, self.chunk, inverse_deviation)

    @torch.no_grad()
    def signed_distance(self, points: Tensor) -> Tensor:
        """Signed distance (N,) float32 at points (N, 3)."""
        distance, evaluator = self._empty(len(points)), self._evaluator()
        for at, part in _chunks(points, self.chunk, self.device):
            distance[at] = evaluator.value(part)
        return distance

    @torch.no_grad()
    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) and its gradient (N, 3) at points (N, 3)."""
        distance, gradient, evaluator = self._empty(len(points)), self._empty(len(points), 3), self._evaluator()
        for at, part in _chunks(points, self.chunk, self.device):
            distance[at], gradient[at] = evaluator.value_and_gradient(part)
        return distance, gradient

    def _evaluator(self) -> Evaluator:
        """What evaluates the function's present parameters."""
        return self.function

    def _empty(self, *shape: int) -> Tensor:
        """For the results: a chunk's own may be a view that keeps all of the last layer's output."""
        return torch.empty(shape, dtype=torch.float32, device=self.device)


def _chunks(points: Tensor, chunk: int | None, device: torch.device) -> Iterator[tuple[slice, Tensor]]:
    """Where each chunk lies, and its points."""
    size = chunk or (_CHUNK if device.type == "cpu" else _CHUNK_ACCELERATOR)
    points = points.to(device=device, dtype=torch.float32)
    for start in range(0, len(points), size):
        at = slice(start, start + size)
        yield at, points[at]


@torch.no_grad()
def _chunked_color(
    function: ColoredFunction, chunk: int | None, device: torch.device, points: Tensor, directions: Tensor
) -> Tensor:
    color = torch.empty((len(points), 3), dtype=torch.float32, device=device)
    directions = directions.to(color)
    for at, part in _chunks(points, chunk, device):
        color[at] = function.color(part, directions[at])
    return color
