"""Fields that users write: an object of their own with SdfField's five members, or a function of points."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.fields.base import SdfField, field_repr

PointFunction = Callable[[Tensor], Any]
"""Signed distance (N,) or (N, 1) at points (N, 3) float32: a tensor or a numpy array of real numbers."""
_CHUNK = 1 << 18
_STEP = 5e-4
"""Of the bounds' diagonal: half the difference that stands for a derivative. float32 keeps three digits of it."""
_PROBES = 16
_HINT = (
    "It takes points (N, 3), a float32 tensor, and returns the signed distance (N,) of each, positive in free space."
)


class UserField:
    """An SdfField of the user's own: it is given float32 points on its device, and what it returns is checked.

    Raises FieldFormatError (FUNCTION_UNUSABLE) where a value is missing, no number or of another shape.
    """

    def __init__(self, field: SdfField) -> None:
        self.field = field
        for name in ("color", "observation", "inverse_deviation", "part_at"):
            if hasattr(field, name):
                setattr(self, name, getattr(field, name))
        self._bounds = checked_bounds(field.bounds)

    def __repr__(self) -> str:
        return field_repr(self)

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float64 on the CPU."""
        return self._bounds

    @property
    def device(self) -> torch.device:
        """That of the field."""
        return torch.device(self.field.device)

    def to(self, device: torch.device | str) -> UserField:
        """The same field on another device."""
        return UserField(self.field.to(device))

    def signed_distance(self, points: Tensor) -> Tensor:
        """Signed distance (N,) float32 at points (N, 3)."""
        given = points.to(device=self.device, dtype=torch.float32)
        return _values("signed_distance", self.field.signed_distance(given), (len(points),), self.device)

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) and its gradient (N, 3) at points (N, 3)."""
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
        """(2, 3) float64 on the CPU."""
        return self._bounds

    def to(self, device: torch.device | str) -> FunctionOfPoints:
        """The same field with its points on another device; a torch module is moved there, as torch does it."""
        if isinstance(self._function, torch.nn.Module):
            self._function.to(device)
        return FunctionOfPoints(self._function, self._bounds, self._sign, device)

    @torch.no_grad()
    def signed_distance(self, points: Tensor) -> Tensor:
        """Signed distance (N,) float32 at points (N, 3)."""
        given = points.to(device=self.device, dtype=torch.float32)
        parts = [self._asked(part) for part in torch.split(given, _CHUNK)]
        return torch.cat(parts) if parts else given.new_zeros(0)

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) and its gradient (N, 3) at points (N, 3)."""
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
    hint = "Write the lowest and the highest corner of the region where the field has meaning: [[x, y, z], [x, y, z]]."
    return FieldFormatError(f"the bounds {what}, expected two corners", reason="BOUNDS_INVALID", hint=hint)


def _values(name: str, found: Any, shape: tuple[int, ...], device: torch.device) -> Tensor:
    """Real numbers of this shape as float32; a column of one counts as a row."""
    if not isinstance(found, Tensor | np.ndarray):
        raise _unusable(f"{name} returns a {type(found).__name__}, expected a tensor or an array of numbers")
    values = torch.from_numpy(np.array(found)) if _is_plain(found) else found
    if not isinstance(values, Tensor) or values.is_complex() or values.dtype == torch.bool:
        raise _unusable(f"{name} returns numbers of the kind {found.dtype}, expected real ones")
    if tuple(values.shape) == (*shape, 1):
        values = values.squeeze(-1)
    if tuple(values.shape) != shape:
        raise _unusable(f"{name} returns the shape {tuple(values.shape)} for {shape[0]} points, expected {shape}")
    return values.to(device=device, dtype=torch.float32)


def _is_plain(found: Any) -> bool:
    return isinstance(found, np.ndarray) and found.dtype.kind in "fiu"


def _device_of(function: PointFunction) -> torch.device | str:
    if isinstance(function, torch.nn.Module):
        return next((one.device for one in (*function.parameters(), *function.buffers())), "cpu")
    return "cpu"


def _unusable(message: str) -> FieldFormatError:
    return FieldFormatError(message, reason="FUNCTION_UNUSABLE", hint=_HINT)
