"""The inner steps by compiled code, on the CPU where the library was built: the same as the tensor algebra beside each
of them, which runs elsewhere and which tests compare with. See regnf_core/native/steps.h and minimize.h.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
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
    "Model", ask=_ADDRESS, described=_ADDRESS, at_once=_I64, checked=_I32, turn=_DOUBLE * 9, shift=_DOUBLE * 3,
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
_Blocks: Any = _structure(
    "Blocks", edge=_I64, low=_I64 * 3, size=_I64 * 3, bits=_I64, step=_I64, near=_I64, origin=_FLOAT * 3,
    voxel_size=_FLOAT, outward=_FLOAT, half=_I32, values=_ADDRESS, blocks=_ADDRESS, slots=_ADDRESS, table=_ADDRESS,
)  # fmt: skip
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
    normals=_I32, keeps_scale=_I32, **dict.fromkeys(_NUMBERS, _DOUBLE),
)  # fmt: skip
_History: Any = _structure(
    "History", scale=_ADDRESS, rotation=_ADDRESS, translation=_ADDRESS, costs=_ADDRESS, of_scene=_ADDRESS,
    of_object=_ADDRESS,
)  # fmt: skip
_DONE, _NO_MEMORY, _NOT_FINITE = range(3)
"""As in field.h."""
_FARTHEST = 1e150
"""Of coordinates whose squared distances are finite."""
_FEW = 4096
"""Points below which another thread does not pay."""
_AT_ONCE = 2048
"""Points that a compiled model is requested at once: what is worked out of them stays in a core's own cache."""


def room(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Memory for results of compiled code, whatever torch's present defaults are."""
    return torch.empty(shape, dtype=dtype, device="cpu")


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


def block_slots(steps: Steps, numbers: Tensor, rows: Tensor) -> Tensor:
    """(S, 2) int64: where compiled code finds the rows (N,) of blocks by their numbers (N,), all different and none
    negative. Of S, a power of two, more than half are free."""
    bits = len(numbers).bit_length() + 1
    slots = room(1 << bits, 2, dtype=torch.int64)
    numbers, rows = numbers.contiguous(), rows.contiguous()
    steps.block_slots(numbers.data_ptr(), rows.data_ptr(), len(numbers), bits, slots.data_ptr())
    return slots


def blocks(
    box: tuple[Tensor, Tensor], slots: Tensor, table: Tensor, step: int, origin: Tensor, lengths: tuple[float, float],
    values: Tensor, blocks: Tensor,
) -> Kept:  # fmt: skip
    """regnf_blocks. box: the lowest block and how many there are along each axis, (3,) each · slots: of `block_slots` ·
    table: (A, B, C, K) rows of the blocks near ``step``^3 · lengths: of a voxel, and outward · values: (B, R, R, R)
    float32 or float16 · blocks: (B, 3). Whole numbers are int64."""
    low, size = ((_I64 * 3)(*one.tolist()) for one in box)
    return Kept(
        _Blocks, edge=values.shape[1], low=low, size=size, bits=len(slots).bit_length() - 1, step=step,
        near=table.shape[3], origin=(_FLOAT * 3)(*origin.tolist()), voxel_size=lengths[0], outward=lengths[1],
        half=values.dtype == torch.float16, values=values, blocks=blocks, slots=slots, table=table,
    )  # fmt: skip


def in_threads(part: Callable[[int, int], None], count: int) -> None:
    """Call ``part`` with the begins and ends of parts of ``count`` points, in as many threads as torch has."""
    threads = min(torch.get_num_threads(), count // _FEW)
    if threads < 2:
        part(0, count)
        return
    cuts = np.linspace(0, count, 4 * threads + 1).astype(int).tolist()
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(part, cuts[:-1], cuts[1:]))


# A model of distances that compiled code asks.


@dataclass(frozen=True)
class NativeModel:
    """A function of points in compiled code, seen through a linear map: factor f(turn x + shift).

    ask: a regnf_ask · described: what it is given, with an ``address`` · turn: (9,) · shift: (3,) · checked: whether a
    value that is not finite is a fault · counted: called with the number of points that it was requested.
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
        """f (N,) itself, without the map, at points (N, 3) float32 on the CPU, in threads where they are many."""
        return self._asked(points, None)

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """f (N,) itself and its gradient (N, 3)."""
        gradient = room(len(points), 3)
        return self._asked(points, gradient), gradient

    def _asked(self, points: Tensor, gradient: Tensor | None) -> Tensor:
        points, value = points.contiguous(), room(len(points))
        assert points.dtype == torch.float32
        assert points.shape[1:] == (3,)

        def part(begin: int, end: int) -> None:
            to = None if gradient is None else gradient[begin:].data_ptr()
            at, found = points[begin:].data_ptr(), value[begin:].data_ptr()
            if self.ask(self.described.address, at, end - begin, found, to):
                raise MemoryError("not enough memory to evaluate a field")

        in_threads(part, len(points))
        return value

    def structure(self) -> Any:
        """regnf_model; it holds addresses of this model's parts."""
        return _Model(
            ask=_address_of(self.ask), described=self.described.address, at_once=_AT_ONCE,
            checked=self.checked, turn=(_DOUBLE * 9)(*self.turn), shift=(_DOUBLE * 3)(*self.shift),
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
        self._steps, self._seen, self._kept = steps, seen, list[Tensor]()
        self._asked = [_Asked(self.scene_count, obj), _Asked(self.total - self.scene_count, scene)]
        self._structure = _Pair(
            scene_samples=self._samples(scene_samples), object_samples=self._samples(object_samples),
            scene=self._asked[1].address, obj=self._asked[0].address, seen=None if seen is None else seen.address,
            hidden=None if hidden is None else self._of(hidden, (self.scene_count,)), ahead=ahead,
            min_cosine=min_cosine,
        )  # fmt: skip
        self._address = ctypes.addressof(self._structure)

    def _of(self, tensor: Tensor, shape: tuple[int, ...]) -> int:
        """Its address. It lives as long as the pair."""
        self._kept.append(tensor.reshape(shape).contiguous())
        found: int = self._kept[-1].data_ptr()
        return found

    def _samples(self, parts: Sequence[Tensor]) -> Any:
        count = len(parts[1])
        points, values, normals = map(self._of, parts, ((count, 3), (count,), (count, 3)))
        return _Samples(count=count, points=points, values=values, normals=normals)

    def residuals(self, poses: Sequence[Tensor], offset: Tensor | None) -> tuple[list[Tensor | None], bool]:
        """Values (H, N + M), Jacobians (H, 7, N + M), cosines and, where not all was observed, flags (H, N + M); and
        whether all was finite. poses: scale (H,), rotation (H, 3, 3), translation (H, 3) · offset: (H,)."""
        count, total = len(poses[0]), self.total
        values, cosines, jacobian = room(count, total), room(count, total), room(count, 7, total)
        flags = room(count, total, dtype=torch.bool) if self.partial else None
        given = {"values": values, "jacobian": jacobian, "cosines": cosines}
        rows = Kept(_Rows, **given, **({} if flags is None else {"unobserved": flags}))
        of, steps, address = _poses(poses, offset), self._steps, self._address
        finite = self._fill(
            count,
            lambda of_object, places: steps.places(address, of.address, of_object, places),
            lambda of_object, *found: steps.fill(address, of.address, of_object, rows.address, *found),
        )
        return [values, jacobian, cosines, flags], finite

    def minimize(
        self, poses: Sequence[Tensor], offset: Tensor | None, widths: Sequence[float], numbers: dict[str, Any],
        on_iteration: Callable[[], None], with_history: bool,
    ) -> Minimized:  # fmt: skip
        """poses, offset: see `residuals`; copies of them are moved · numbers: of regnf_settings, by name."""
        count, steps = len(poses[0]), self._steps
        of = _poses([one.clone() for one in poses], None if offset is None else offset.clone())
        along = torch.tensor(widths, dtype=torch.float64, device="cpu")
        settings = Kept(_Settings, iterations=len(widths), widths=along, **numbers)
        history = _history(count, len(widths)) if with_history else None
        scores, sizes = room(count), room(count, self.total)
        kept = None if history is None else history.address
        state = steps.begin(self._address, of.address, settings.address, kept)
        if not state:
            raise MemoryError("not enough memory for the residuals of a registration")
        try:
            for number in range(len(widths) + 1):
                if number:
                    steps.step(state)
                finite = self._fill(
                    count,
                    lambda of_object, places: steps.next_places(state, of_object, places),
                    lambda of_object, *found: steps.next_fill(state, of_object, *found),
                )
                if not finite:
                    break
                steps.settle(state)
                if number:
                    on_iteration()
            steps.score(state, scores.data_ptr(), sizes.data_ptr())
        finally:
            steps.end(state)
        return Minimized(of.tensors, scores, sizes, {} if history is None else history.tensors, finite)

    def _fill(self, poses: int, places: Callable[..., None], fill: Callable[..., int]) -> bool:
        """The residuals of both surfaces' samples; whether all was finite. places, fill: see field.h."""
        for of_object, asked in enumerate(self._asked):
            found: tuple[int | None, int | None] = (None, None)
            if asked.native is None:
                points = room(poses * asked.samples, 3)
                places(of_object, points.data_ptr())
                value, gradient = (part.float() for part in asked.model.value_and_gradient(points))
                # The code trusts their sizes, and a caller's own field may have any: reshape raises RuntimeError then.
                value = value.reshape(len(points)).contiguous()
                gradient = gradient.reshape(len(points), 3).contiguous()
                found = value.data_ptr(), gradient.data_ptr()
            fault = fill(of_object, *found)
            if fault == _NO_MEMORY:
                raise MemoryError("not enough memory for the residuals of a registration")
            asked.count(poses)
            if fault != _DONE:
                return False
        return True


class _Asked:
    """What the samples of one surface are asked of: ``samples`` of them at each pose. address: of its regnf_model, or
    None where it is no compiled code's."""

    def __init__(self, samples: int, model: Any) -> None:
        self.samples, self.model, self.native = samples, model, native_model(model)
        self._structure = None if self.native is None else self.native.structure()
        self.address = None if self._structure is None else ctypes.addressof(self._structure)

    def count(self, poses: int) -> None:
        for counted in () if self.native is None else self.native.counted:
            counted(poses * self.samples)


def _poses(poses: Sequence[Tensor], offset: Tensor | None) -> Kept:
    count = len(poses[0])
    shapes = {"scale": (count,), "rotation": (count, 3, 3), "translation": (count, 3), "offset": (count,)}
    given = dict(zip(shapes, (*poses, *([] if offset is None else [offset])), strict=False))
    return Kept(_Poses, count=count, **{name: one.double().expand(shapes[name]) for name, one in given.items()})


def _history(count: int, steps: int) -> Kept:
    T = {"scale": (), "rotation": (3, 3), "translation": (3,)}
    parts = {name: room(count, steps, *shape, dtype=torch.float64) for name, shape in T.items()}
    return Kept(_History, **parts, **{name: room(count, steps) for name in ("costs", "of_scene", "of_object")})


@dataclass(frozen=True, eq=False)
class Minimized:
    """poses: by name, ``offset`` among them where there is one · scores: (H,) · sizes: (H, N + M) of the residuals ·
    history: by name, (H, iterations) each · finite: whether all that the fields said was."""

    poses: dict[str, Tensor]
    scores: Tensor
    sizes: Tensor
    history: dict[str, Tensor]
    finite: bool


def _is_near(points: Tensor) -> bool:
    """Whether all coordinates are finite, and their squared distances."""
    return bool((np.abs(points.numpy()) < _FARTHEST).all())


def nearest(points: Tensor, places: Tensor, count: int) -> tuple[Tensor, Tensor] | None:
    """Distances (N, K) from places (N, 3) to the ``count`` nearest of points (M, 3), nearest first, and their numbers
    (N, K); None where there is no compiled code for it."""
    found = variant()
    if found is None or points.device.type != "cpu" or not 1 <= count <= min(_MOST_NEAR, len(points)):
        return None
    of, at = points.double().contiguous(), places.cpu().double().contiguous()
    if not all(_is_near(one) for one in (of, at)):
        return None
    distance, number = room(len(at), count, dtype=torch.float64), room(len(at), count, dtype=torch.int64)
    if found.steps.nearest(
        of.data_ptr(), len(of), at.data_ptr(), len(at), count, distance.data_ptr(), number.data_ptr()
    ):
        raise MemoryError("not enough memory to search neighbors")
    return distance.to(places), number.to(places.device)


def nearest_to_cells(points: Tensor, low: Tensor, edge: Tensor, cells: int) -> tuple[Tensor, Tensor] | None:
    """Distance (C,) from the center of each cell of a cubic grid, z fastest, to the nearest of points (N, 3), N >= 1,
    and its number (C,); None where there is no compiled code for it. low, edge: (3,), the grid's corner and a cell's
    edges · cells: along an axis."""
    found = variant()
    if found is None or points.device.type != "cpu" or len(points) == 0:
        return None
    of, corner, edges = (part.double().contiguous() for part in (points, low, edge))
    if not all(_is_near(one) for one in (of, corner, edges)):
        return None
    distance, number = room(cells**3, dtype=torch.float64), room(cells**3, dtype=torch.int64)
    if found.steps.nearest_to_cells(
        of.data_ptr(), len(of), corner.data_ptr(), edges.data_ptr(), cells, distance.data_ptr(), number.data_ptr()
    ):
        raise MemoryError("not enough memory to search neighbors")
    return distance.to(points), number


def kernel_sums(places: Tensor, normals: Tensor, lengths: Tensor, weights: Tensor) -> Tensor | None:
    """(N, N): the sum over the lengths (L,) of weights (L,) times the squared exponential kernel of that length, at
    places (N, 3) and normals (N, 3) whose kernel has the length 1; None where there is no compiled code for it."""
    found = variant()
    if found is None or places.device.type != "cpu":
        return None
    x, u = (part.float().T.contiguous() for part in (places, normals))
    factors, weighted = (-0.5 / lengths.square()).float(), weights.float().contiguous()
    n, sums = len(places), room(len(places), len(places))
    found.steps.kernel_sums(
        x.data_ptr(), u.data_ptr(), n, factors.data_ptr(), weighted.data_ptr(), len(lengths), sums.data_ptr()
    )
    return sums
