"""The inner steps by compiled code, on the CPU where the library was built: the same as the tensor algebra beside each
of them, which runs elsewhere and which tests compare with. See regnf_core/native/steps.h and minimize.h.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from regnf_core.native.library import Steps, variant

_MOST_NEAR = 64
"""As in near.h."""
_I64, _I32, _FLOAT, _ADDRESS = ctypes.c_int64, ctypes.c_int32, ctypes.c_float, ctypes.c_void_p


def _structure(name: str, **members: Any) -> type[ctypes.Structure]:
    return type(name, (ctypes.Structure,), {"_fields_": tuple(members.items())})


_DOUBLE = ctypes.c_double
_Samples: Any = _structure("Samples", count=_I64, points=_ADDRESS, values=_ADDRESS, normals=_ADDRESS)
_Model: Any = _structure(
    "Model", ask=_ADDRESS, described=_ADDRESS, at_once=_I64, as_it_is=_I32, turn=_DOUBLE * 9, shift=_DOUBLE * 3,
    factor=_DOUBLE,
)  # fmt: skip
_Poses: Any = _structure("Poses", count=_I64, scale=_ADDRESS, rotation=_ADDRESS, translation=_ADDRESS, offset=_ADDRESS)
_Rows: Any = _structure("Rows", values=_ADDRESS, jacobian=_ADDRESS, cosines=_ADDRESS, unobserved=_ADDRESS)
_Observation: Any = _structure(
    "Observation", counts=_I64 * 3, states=_ADDRESS, turn=_FLOAT * 9, shift=_FLOAT * 3, ahead=_FLOAT, agreement=_FLOAT
)
_Planes: Any = _structure("Planes", cells=_I64, low=_FLOAT * 3, high=_FLOAT * 3, edge=_FLOAT * 3, planes=_ADDRESS)
_Voxels: Any = _structure(
    "Voxels", counts=_I64 * 3, low=_FLOAT * 3, high=_FLOAT * 3, spacing=_FLOAT * 3, outward=_FLOAT, values=_ADDRESS
)
_Pair: Any = _structure(
    "Pair", scene_samples=_Samples, object_samples=_Samples, scene=_ADDRESS, obj=_ADDRESS, seen=_ADDRESS,
    hidden=_ADDRESS, ahead=_FLOAT, min_cosine=_FLOAT,
)  # fmt: skip
_NUMBERS = (
    "damping_start", "damping_low", "damping_high", "damping_decrease", "damping_increase", "min_damping",
    "relative_damping", "fixed_damping", "max_step", "spread_quantile", "spread_factor", "unobserved_width",
    "min_observed_share", "unobserved_loss", "offset_prior", "score_width",
)  # fmt: skip
_Settings: Any = _structure(
    "Settings", iterations=_I64, widths=_ADDRESS, widest=_DOUBLE, low=_DOUBLE, high=_DOUBLE, max_offset=_DOUBLE,
    normals=_I32, keeps_scale=_I32, **dict.fromkeys(_NUMBERS, _DOUBLE), on_iteration=_ADDRESS,
)  # fmt: skip
_History: Any = _structure(
    "History", scale=_ADDRESS, rotation=_ADDRESS, translation=_ADDRESS, costs=_ADDRESS, of_scene=_ADDRESS,
    of_object=_ADDRESS,
)  # fmt: skip
_ASK = ctypes.CFUNCTYPE(ctypes.c_int, _ADDRESS, _ADDRESS, _I64, _ADDRESS, _ADDRESS)
_CALLED = ctypes.CFUNCTYPE(ctypes.c_int)
_DONE, _NO_MEMORY, _ASKED_IN_VAIN, _NOT_FINITE, _STOPPED = range(5)
"""As in field.h."""
_AT_ONCE = 2048
"""Points that a compiled model is asked for at once: what is worked out of them stays in a core's own cache."""


def steps_for(*tensors: Tensor) -> Steps | None:
    """The compiled steps, where all of the tensors are float32 on the CPU, and nobody wants their derivatives."""
    found = variant()
    if found is None or not all(one.device.type == "cpu" and one.dtype == torch.float32 for one in tensors):
        return None
    return None if torch.is_grad_enabled() and any(one.requires_grad for one in tensors) else found.steps


class Kept:
    """A C structure, and the tensors whose addresses it holds."""

    def __init__(self, kind: Any, **members: Any) -> None:
        self.tensors = {name: one.contiguous() for name, one in members.items() if isinstance(one, Tensor)}
        rest = {name: one for name, one in members.items() if not isinstance(one, Tensor)}
        self._structure = kind(**rest, **{name: one.data_ptr() for name, one in self.tensors.items()})
        self.address = ctypes.addressof(self._structure)


def observation(states: Tensor, counts: Tensor, turn: Tensor, shift: Tensor, ahead: float, agreement: float) -> Kept:
    """regnf_observation. states: uint8, of all voxels, z fastest · counts: (3,) · turn: (3, 3) · shift: (3,)."""
    arrays = {"turn": (_FLOAT * 9)(*turn.flatten().tolist()), "shift": (_FLOAT * 3)(*shift.tolist())}
    counted = (_I64 * 3)(*counts.tolist())
    return Kept(_Observation, counts=counted, states=states.to(torch.uint8), **arrays, ahead=ahead, agreement=agreement)


def planes(cells: int, low: Tensor, high: Tensor, edge: Tensor, planes: Tensor) -> Kept:
    """regnf_planes."""
    corners = {"low": low, "high": high, "edge": edge}
    given = {name: (_FLOAT * 3)(*one.flatten().tolist()) for name, one in corners.items()}
    return Kept(_Planes, cells=cells, **given, planes=planes)


def voxels(counts: Sequence[int], low: Tensor, high: Tensor, spacing: Tensor, outward: float, values: Tensor) -> Kept:
    """regnf_voxels."""
    corners = {"low": low, "high": high, "spacing": spacing}
    given = {name: (_FLOAT * 3)(*one.flatten().tolist()) for name, one in corners.items()}
    return Kept(_Voxels, counts=(_I64 * 3)(*counts), **given, outward=outward, values=values)


# A model of distances that compiled code asks.


@dataclass(frozen=True)
class NativeModel:
    """A function of points in compiled code, seen through a linear map: factor f(turn x + shift).

    ask: a regnf_ask · described: what it is given, with an ``address`` · turn: (9,) · shift: (3,) · checked: whether a
    value that is not finite is a fault · counted: called with the number of points that it was asked for.
    """

    ask: Any
    described: Any
    turn: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    shift: tuple[float, ...] = (0.0, 0.0, 0.0)
    factor: float = 1.0
    checked: bool = True
    counted: tuple[Callable[[int], None], ...] = ()

    def seen_by(self, turn: Any, shift: Any, factor: float) -> NativeModel:
        """factor g(turn x + shift) where this is g. turn: (3, 3) · shift: (3,)."""
        inner = np.array(self.turn).reshape(3, 3)
        turned, moved = inner @ np.asarray(turn, np.float64), inner @ np.asarray(shift, np.float64) + self.shift
        return self._with(turn=tuple(turned.ravel()), shift=tuple(moved), factor=self.factor * factor)

    def counting(self, count: Callable[[int], None]) -> NativeModel:
        """The same, whose points are counted."""
        return self._with(counted=(*self.counted, count))

    def _with(self, **changes: Any) -> NativeModel:
        return NativeModel(**{**vars(self), **changes})

    def value(self, points: Tensor) -> Tensor:
        """f (N,) itself, without the map, at points (N, 3) float32 on the CPU."""
        return self._asked(points, None)

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """f (N,) itself and its gradient (N, 3)."""
        gradient = torch.empty(len(points), 3)
        return self._asked(points, gradient), gradient

    def _asked(self, points: Tensor, gradient: Tensor | None) -> Tensor:
        points, value = points.contiguous(), torch.empty(len(points))
        assert points.dtype == torch.float32
        assert points.shape[1:] == (3,)
        to = None if gradient is None else gradient.data_ptr()
        if self.ask(self.described.address, points.data_ptr(), len(points), value.data_ptr(), to):
            raise MemoryError("no memory for the evaluation of a field")
        return value

    def structure(self) -> Any:
        """regnf_model; it holds addresses of this model's parts."""
        return _Model(
            ask=_address_of(self.ask), described=self.described.address, at_once=_AT_ONCE,
            as_it_is=not self.checked, turn=(_DOUBLE * 9)(*self.turn), shift=(_DOUBLE * 3)(*self.shift),
            factor=self.factor,
        )  # fmt: skip


def _address_of(function: Any) -> int:
    """Of a function of ctypes. A cast would give it too, and make the function hold itself."""
    found: int = _ADDRESS.from_buffer(function).value or 0
    return found


def native_model(of: Any) -> NativeModel | None:
    """What compiled code asks in place of a field or a model of distances; None: it has nothing of the kind."""
    found = getattr(of, "native_model", None)
    model: NativeModel | None = None if found is None or variant() is None else found()
    return model


class Called:
    """Functions of Python that compiled code calls, and the first error in one of them."""

    def __init__(self) -> None:
        self._functions: list[Any] = []
        self._errors: list[BaseException] = []

    def on_iteration(self, function: Callable[[], None]) -> int:
        """The address of a function that calls this one."""

        errors = self._errors  # not this object, which holds the function: only a collection would free both

        def called() -> int:
            return _guarded(function, _STOPPED, errors)

        return self._address(_CALLED(called))

    def model(self, of: Any) -> Any:
        """regnf_model of what has a ``value_and_gradient``."""

        errors = self._errors

        def asked(_described: int, points: int, count: int, value: int, gradient: int) -> int:
            return _guarded(lambda: _answer(of, points, count, value, gradient), _ASKED_IN_VAIN, errors)

        return _Model(ask=self._address(_ASK(asked)), as_it_is=True)

    def require(self, fault: int) -> bool:
        """Whether all was finite. Raises what a function raised, or MemoryError."""
        if self._errors:
            raise self._errors[0]
        if fault == _NO_MEMORY:
            raise MemoryError("no memory for a registration's residuals")
        assert fault in (_DONE, _NOT_FINITE)
        return bool(fault == _DONE)

    def _address(self, function: Any) -> int:
        self._functions.append(function)
        return _address_of(function)


def _guarded(function: Callable[[], None], fault: int, errors: list[BaseException]) -> int:
    """0, or the fault where the function raised; its error is added."""
    try:
        function()
    except BaseException as error:  # noqa: BLE001 -- compiled code is in between; it is raised after it
        errors.append(error)
        return fault
    return _DONE


def _answer(model: Any, points: int, count: int, value: int, gradient: int) -> None:
    places = torch.empty(count, 3)
    ctypes.memmove(places.data_ptr(), points, 12 * count)
    distance, slope = (part.float() for part in model.value_and_gradient(places))
    # The code trusts their sizes, and a caller's own field may have any: reshape raises RuntimeError then.
    distance, slope = distance.reshape(count).contiguous(), slope.reshape(count, 3).contiguous()
    ctypes.memmove(value, distance.data_ptr(), 4 * count)
    ctypes.memmove(gradient, slope.data_ptr(), 12 * count)


class Pair:
    """Two surfaces for compiled code."""

    def __init__(
        self, steps: Steps, scene_samples: Sequence[Tensor], object_samples: Sequence[Tensor], scene: Any, obj: Any,
        seen: Kept | None, hidden: Tensor | None, ahead: float, min_cosine: float,
    ) -> None:  # fmt: skip
        """samples: points (N, 3), values (N,), normals (N, 3) · scene, obj: what each surface's distances are asked
        of · seen: regnf_observation, of the scene · hidden: (N,) bool, see
        :class:`regnf_core.robust.working_frame.Samples`."""
        self.scene_count, self.total = len(scene_samples[1]), len(scene_samples[1]) + len(object_samples[1])
        self.partial = seen is not None
        self._steps, self._called = steps, Called()
        self._kept: list[Any] = [seen]
        self._counted = [(self.total - self.scene_count, native_model(scene)), (self.scene_count, native_model(obj))]
        models = [
            self._called.model(one) if native is None else native.structure()
            for one, (_, native) in zip((scene, obj), self._counted, strict=True)
        ]
        self._kept += [scene, obj, models]
        self._structure = _Pair(
            scene_samples=self._samples(scene_samples), object_samples=self._samples(object_samples),
            scene=ctypes.addressof(models[0]), obj=ctypes.addressof(models[1]),
            seen=None if seen is None else seen.address, hidden=None if hidden is None else self._of(hidden),
            ahead=ahead, min_cosine=min_cosine,
        )  # fmt: skip

    def _of(self, tensor: Tensor) -> int:
        """Its address. It lives as long as the pair."""
        self._kept.append(tensor.contiguous())
        found: int = self._kept[-1].data_ptr()
        return found

    def _samples(self, parts: Sequence[Tensor]) -> Any:
        points, values, normals = map(self._of, parts)
        return _Samples(count=len(parts[1]), points=points, values=values, normals=normals)

    def residuals(self, poses: Sequence[Tensor], offset: Tensor | None) -> tuple[list[Tensor | None], bool]:
        """Values (H, N + M), Jacobians (H, 7, N + M), cosines and, where not all was observed, flags (H, N + M); and
        whether all was finite. poses: scale (H,), rotation (H, 3, 3), translation (H, 3) · offset: (H,)."""
        count, total = len(poses[0]), self.total
        values, cosines = torch.empty(2, count, total)
        jacobian = torch.empty(count, 7, total)
        flags = torch.empty(count, total, dtype=torch.bool) if self.partial else None
        given = {"values": values, "jacobian": jacobian, "cosines": cosines}
        rows = Kept(_Rows, **given, **({} if flags is None else {"unobserved": flags}))
        of, at = self._poses(poses, offset), ctypes.addressof
        finite = self._called.require(self._steps.residuals(at(self._structure), of.address, rows.address))
        self._count(count)
        return [values, jacobian, cosines, flags], finite

    def minimize(
        self, poses: Sequence[Tensor], offset: Tensor | None, widths: Sequence[float], numbers: dict[str, Any],
        on_iteration: Callable[[], None], with_history: bool,
    ) -> Minimized:  # fmt: skip
        """poses, offset: see `residuals`; copies of them are moved · numbers: of regnf_settings, by name."""
        count, steps = len(poses[0]), len(widths)
        of = self._poses([one.clone() for one in poses], None if offset is None else offset.clone())
        scores, sizes = torch.empty(count), torch.empty(count, self.total)
        along = torch.tensor(widths, dtype=torch.float64)
        called = self._called.on_iteration(on_iteration)
        settings = Kept(_Settings, iterations=steps, widths=along, on_iteration=called, **numbers)
        history: Kept | None = None
        if with_history:
            T = {"scale": (), "rotation": (3, 3), "translation": (3,)}
            parts = {name: torch.empty(count, steps, *shape, dtype=torch.float64) for name, shape in T.items()}
            rest = {name: torch.empty(count, steps) for name in ("costs", "of_scene", "of_object")}
            history = Kept(_History, **parts, **rest)
        fault = self._steps.minimize(
            ctypes.addressof(self._structure), of.address, settings.address, scores.data_ptr(), sizes.data_ptr(),
            None if history is None else history.address,
        )  # fmt: skip
        finite = self._called.require(fault)
        self._count(count * (steps + 1))
        return Minimized(of.tensors, scores, sizes, {} if history is None else history.tensors, finite)

    def _poses(self, poses: Sequence[Tensor], offset: Tensor | None) -> Kept:
        parts = dict(zip(("scale", "rotation", "translation"), poses, strict=True))
        if offset is not None:
            parts["offset"] = offset
        return Kept(_Poses, count=len(poses[0]), **{name: one.double() for name, one in parts.items()})

    def _count(self, times: int) -> None:
        for samples, native in self._counted:
            for counted in () if native is None else native.counted:
                counted(times * samples)


@dataclass(frozen=True, eq=False)
class Minimized:
    """poses: by name, ``offset`` among them where there is one · scores: (H,) · sizes: (H, N + M) of the residuals ·
    history: by name, (H, iterations) each · finite: whether all that the fields said was."""

    poses: dict[str, Tensor]
    scores: Tensor
    sizes: Tensor
    history: dict[str, Tensor]
    finite: bool


def nearest(points: Tensor, places: Tensor, count: int) -> tuple[Tensor, Tensor] | None:
    """Distances (N, K) from places (N, 3) to the ``count`` nearest of points (M, 3), nearest first, and their numbers
    (N, K); None where there is no compiled code for it."""
    found = variant()
    if found is None or points.device.type != "cpu" or not 1 <= count <= min(_MOST_NEAR, len(points)):
        return None
    of, at = points.double().contiguous(), places.cpu().double().contiguous()
    if not all(np.isfinite(one.numpy()).all() for one in (of, at)):
        return None
    distance, number = torch.empty(len(at), count, dtype=torch.float64), torch.empty(len(at), count, dtype=torch.int64)
    if found.steps.nearest(
        of.data_ptr(), len(of), at.data_ptr(), len(at), count, distance.data_ptr(), number.data_ptr()
    ):
        raise MemoryError("no memory for a search of neighbors")
    return distance.to(places), number.to(places.device)


def nearest_to_cells(points: Tensor, low: Tensor, edge: Tensor, cells: int) -> tuple[Tensor, Tensor] | None:
    """Distance (C,) from the center of each cell of a cubic grid, z fastest, to the nearest of points (N, 3), N >= 1,
    and its number (C,); None where there is no compiled code for it. low, edge: (3,), the grid's corner and a cell's
    edges · cells: along an axis."""
    found = variant()
    if found is None or points.device.type != "cpu" or len(points) == 0:
        return None
    of, corner, edges = (part.double().contiguous() for part in (points, low, edge))
    if not all(np.isfinite(one.numpy()).all() for one in (of, corner, edges)):
        return None
    distance, number = torch.empty(cells**3, dtype=torch.float64), torch.empty(cells**3, dtype=torch.int64)
    if found.steps.nearest_to_cells(
        of.data_ptr(), len(of), corner.data_ptr(), edges.data_ptr(), cells, distance.data_ptr(), number.data_ptr()
    ):
        raise MemoryError("no memory for a search of neighbors")
    return distance.to(points), number


def kernel_sums(places: Tensor, normals: Tensor, lengths: Tensor, weights: Tensor) -> Tensor | None:
    """(N, N): the sum over the lengths (L,) of weights (L,) times the squared exponential kernel of that length, at
    places (N, 3) and normals (N, 3) whose kernel has the length 1; None where there is no compiled code for it."""
    found = variant()
    if found is None:
        return None
    x, u = (part.float().T.contiguous() for part in (places, normals))
    factors, weighted = (-0.5 / lengths.square()).float(), weights.float().contiguous()
    n, sums = len(places), torch.empty(len(places), len(places))
    found.steps.kernel_sums(
        x.data_ptr(), u.data_ptr(), n, factors.data_ptr(), weighted.data_ptr(), len(lengths), sums.data_ptr()
    )
    return sums
