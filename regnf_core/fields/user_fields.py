"""Fields that users write: an object of their own with SdfField's five members, or a function of points."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, Protocol, Self, TypeVar, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.fields.observation import ColorFunction, FieldView, OnDevice, SdfField, field_repr
from regnf_core.fields.recorded_kernels import RecordedEvaluation

PointFunction = Callable[[Tensor], Any]
"""Signed distance (N,) or (N, 1) at points (N, 3) float32: a tensor or a numpy array of real numbers."""
_CHUNK = 1 << 18
_STEP = 5e-4
"""Of the bounds' diagonal: half the difference that stands for a derivative. float32 keeps three digits of it."""
_PROBES = 16
_HINT = (
    "The function takes points (N, 3), a float32 tensor, and returns their signed distances (N,), positive in free "
    "space."
)


class UserField(FieldView):
    """An SdfField of the user's own: it is given float32 points on its device, and what it returns is checked.

    Raises FieldFormatError (FUNCTION_UNUSABLE) where a value is missing, no number or of another shape.
    """

    def __init__(self, field: SdfField) -> None:
        super().__init__(field)
        if hasattr(field, "part_at"):
            self.part_at = field.part_at
        self._bounds = checked_bounds(field.bounds)

    def __repr__(self) -> str:
        return field_repr(self)

    @property
    def bounds(self) -> Tensor:
        return self._bounds

    @property
    def device(self) -> torch.device:
        return torch.device(self.field.device)

    def to(self, device: torch.device | str) -> UserField:
        return UserField(self.field.to(device))

    def signed_distance(self, points: Tensor) -> Tensor:
        given = points.to(device=self.device, dtype=torch.float32)
        return _values("signed_distance", self.field.signed_distance(given), (len(points),), self.device)

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        given, name = points.to(device=self.device, dtype=torch.float32), "signed_distance_and_gradient"
        found = self.field.signed_distance_and_gradient(given)
        if not isinstance(found, tuple | list) or len(found) != 2:
            raise _unusable(f"{name} returns a {type(found).__name__}, expected a distance and a gradient")
        distance, gradient = (
            _values(name, one, shape, self.device)
            for one, shape in zip(found, ((len(points),), (len(points), 3)), strict=True)
        )
        return distance, gradient


class FunctionOfPoints:
    """A function of points as an SdfField. bounds: (2, 3) · sign: -1 where it is negative in free space.

    The gradient is autograd's where the function's result depends on its points by torch's operations, else a central
    difference over a thousandth of the bounds' diagonal. Raises FieldFormatError (FUNCTION_UNUSABLE).
    """

    def __init__(
        self, function: PointFunction, bounds: Any, sign: int = 1, device: torch.device | str | None = None
    ) -> None:
        self._function, self._sign = function, sign
        self._bounds = checked_bounds(bounds)
        if sign not in (1, -1):
            raise _unusable(f"sign is {sign!r}, expected 1 or -1")
        self.device = torch.device(_device_of(function) if device is None else device)
        low, high = self._bounds
        self._step = _STEP * float((high - low).norm())
        generator = torch.Generator().manual_seed(0)
        probes = (low + (high - low) * torch.rand(_PROBES, 3, generator=generator)).float().to(self.device)
        self.signed_distance(probes)
        self._differentiable = self._has_graph(probes)

    def __repr__(self) -> str:
        return field_repr(self)

    @property
    def bounds(self) -> Tensor:
        return self._bounds

    def to(self, device: torch.device | str) -> FunctionOfPoints:
        """The same field with its points on another device; a torch module is moved there, as torch does it."""
        if isinstance(self._function, torch.nn.Module):
            self._function.to(device)
        return FunctionOfPoints(self._function, self._bounds, self._sign, device)

    @torch.no_grad()
    def signed_distance(self, points: Tensor) -> Tensor:
        given = points.to(device=self.device, dtype=torch.float32)
        parts = [self._asked(part) for part in torch.split(given, _CHUNK)]
        return torch.cat(parts) if parts else given.new_zeros(0)

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        given = points.to(device=self.device, dtype=torch.float32).detach()
        parts = [self._with_gradient(part) for part in torch.split(given, _CHUNK)]
        distance, gradient = (torch.cat(some) for some in zip(*parts, strict=True))
        return distance, gradient

    def _with_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        if self._differentiable and len(points):
            with torch.enable_grad():
                at = points.clone().requires_grad_(True)
                distance = self._asked(at)
                (gradient,) = torch.autograd.grad(distance.sum(), at)
            return distance.detach(), gradient
        steps = self._step * torch.eye(3, device=points.device)
        ends = [self.signed_distance(points + side * step) for step in steps for side in (1.0, -1.0)]
        along = [(ends[2 * axis] - ends[2 * axis + 1]) / (2.0 * self._step) for axis in range(3)]
        return self.signed_distance(points), torch.stack(along, dim=-1)

    def _has_graph(self, points: Tensor) -> bool:
        """Whether autograd can follow the function from its result to its points."""
        try:
            with torch.enable_grad():
                at = points.clone().requires_grad_(True)
                found = self._asked(at)
                if not found.requires_grad:
                    return False
                (gradient,) = torch.autograd.grad(found.sum(), at, allow_unused=True)
            return gradient is not None and bool(torch.isfinite(gradient).all())
        except (FieldFormatError, RuntimeError):  # it has been asked without a graph, and answered
            return False

    def _asked(self, points: Tensor) -> Tensor:
        try:
            found = self._function(points)
        except Exception as error:
            message = f"the function raised {type(error).__name__} at points ({len(points)}, 3): {error}"
            raise _unusable(message) from error
        if self._sign < 0:
            return -_values("the function", found, (len(points),), self.device)
        return _values("the function", found, (len(points),), self.device)


def checked_bounds(bounds: Any) -> Tensor:
    """(2, 3) float64 on the CPU. Raises FieldFormatError (BOUNDS_INVALID)."""
    try:
        found = torch.as_tensor(np.asarray(bounds.detach().cpu() if isinstance(bounds, Tensor) else bounds, np.float64))
    except (TypeError, ValueError) as error:
        raise _no_bounds("are not numbers") from error
    if tuple(found.shape) != (2, 3):
        raise _no_bounds(f"have the shape {tuple(found.shape)}")
    if not torch.isfinite(found).all() or not (found[0] < found[1]).all():
        raise _no_bounds(f"are {found.tolist()}")
    return found


def _no_bounds(what: str) -> FieldFormatError:
    hint = "Write the lowest and the highest corner of the region in which the field is valid: [[x, y, z], [x, y, z]]."
    return FieldFormatError(f"the bounds {what}, expected two corners", reason="BOUNDS_INVALID", hint=hint)


def _values(name: str, found: Any, shape: tuple[int, ...], device: torch.device) -> Tensor:
    """Real numbers of this shape as float32; a column of one counts as a row."""
    if not isinstance(found, Tensor | np.ndarray):
        raise _unusable(f"{name} returns a {type(found).__name__}, expected a tensor or an array of numbers")
    plain = isinstance(found, np.ndarray) and found.dtype.kind in "fiu"
    values = torch.from_numpy(np.array(found)) if plain else found
    if not isinstance(values, Tensor) or values.is_complex() or values.dtype == torch.bool:
        raise _unusable(f"{name} returns numbers of the type {found.dtype}, expected real numbers")
    if tuple(values.shape) == (*shape, 1):
        values = values.squeeze(-1)
    if tuple(values.shape) != shape:
        raise _unusable(f"{name} returns the shape {tuple(values.shape)} for {shape[0]} points, expected {shape}")
    return values.to(device=device, dtype=torch.float32)


def _device_of(function: PointFunction) -> torch.device | str:
    if isinstance(function, torch.nn.Module):
        return next((one.device for one in (*function.parameters(), *function.buffers())), "cpu")
    return "cpu"


def _unusable(message: str) -> FieldFormatError:
    return FieldFormatError(message, reason="FUNCTION_UNUSABLE", hint=_HINT)


# A function of points as an SdfField: no autograd graph, in chunks, on the device of its parameters.

_FUNCTION_CHUNK = 1 << 10  # the layers' outputs at so many points fit a core's own cache
_CHUNK_ACCELERATOR = 1 << 18


class Evaluator(Protocol):
    """What evaluates a function's present parameters, without a graph."""

    def value(self, points: Tensor) -> Tensor:
        """Signed distance (N,) at points (N, 3) float32, both on the function's device."""
        ...

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) at points (N, 3) and its gradient (N, 3) with respect to them, in closed form."""
        ...


class SdfFunction(Evaluator, Protocol):
    """What a kind of field has to write."""

    @property
    def device(self) -> torch.device:
        """Where the parameters live."""
        ...

    def to(self, device: torch.device | str) -> Self:
        """The same function with its parameters on another device."""
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
        self._recorded = RecordedEvaluation(function.value_and_gradient) if function.device.type == "cuda" else None

    def __repr__(self) -> str:
        return field_repr(self)

    @property
    def bounds(self) -> Tensor:
        return self._bounds

    @property
    def device(self) -> torch.device:
        return self.function.device

    def to(self, device: torch.device | str) -> Self:
        return type(self)(self.function.to(device), self._bounds, self.chunk, self.inverse_deviation)

    def with_inverse_deviation(self, inverse_deviation: float | None) -> Self:
        return type(self)(self.function, self._bounds, self.chunk, inverse_deviation)

    @torch.no_grad()
    def signed_distance(self, points: Tensor) -> Tensor:
        distance, evaluator = self._empty(len(points)), self._evaluator()
        for at, part in _chunks(points, self.chunk, self.device):
            distance[at] = evaluator.value(part)
        return distance

    @torch.no_grad()
    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        distance, gradient = self._empty(len(points)), self._empty(len(points), 3)
        evaluate = self._recorded or self._evaluator().value_and_gradient
        for at, part in _chunks(points, self.chunk, self.device):
            distance[at], gradient[at] = evaluate(part)
        return distance, gradient

    def _evaluator(self) -> Evaluator:
        """What evaluates the function's present parameters."""
        return self.function

    def _empty(self, *shape: int) -> Tensor:
        """For the results: a chunk's own may be a view that keeps all of the last layer's output."""
        return torch.empty(shape, dtype=torch.float32, device=self.device)


def _chunks(points: Tensor, chunk: int | None, device: torch.device) -> Iterator[tuple[slice, Tensor]]:
    """Where each chunk lies, and its points."""
    size = chunk or (_FUNCTION_CHUNK if device.type == "cpu" else _CHUNK_ACCELERATOR)
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


@dataclass(frozen=True)
class BoxExtension(OnDevice, Generic[F]):
    """g in the box; outside, g at the box's nearest point plus the distance to it. Continuous and finite everywhere.

    What lies outside is taken for free space: the true distance is at most so large, and at least the distance to the
    box where the box holds all of the surface.
    low, high: (3,), the box's corners · outward: -1 where g is negative in free space.
    """

    function: F
    low: Tensor
    high: Tensor
    outward: float = 1.0

    @property
    def device(self) -> torch.device:
        return self.function.device

    def value(self, points: Tensor) -> Tensor:
        """g (N,) at points (N, 3), extended."""
        inside = self._nearest(points)
        value: Tensor = self.function.value(inside) + self.outward * (points - inside).norm(dim=-1)
        return value

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """g (N,) at points (N, 3), extended, and its gradient (N, 3)."""
        inside = self._nearest(points)
        value, gradient = self.function.value_and_gradient(inside)
        beyond = points - inside
        way = beyond.norm(dim=-1)
        away = beyond / way.clamp_min(torch.finfo(way.dtype).tiny).unsqueeze(-1)
        # Along an axis that leads out, the nearest point of the box stays where it is.
        gradient = torch.where(beyond == 0.0, gradient, 0.0)
        return value + self.outward * way, gradient + self.outward * away

    @property
    def has_color(self) -> bool:
        return isinstance(self.function, ColoredFunction) and self.function.has_color

    def color(self, points: Tensor, directions: Tensor) -> Tensor:
        """Color (N, 3) of g at points (N, 3); outside, that of the box's nearest point."""
        assert isinstance(self.function, ColoredFunction)
        return self.function.color(self._nearest(points), directions)

    def _nearest(self, points: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(points, self.low), self.high)
