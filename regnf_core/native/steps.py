"""The inner steps by compiled code, on the CPU where the library was built: the same as the tensor algebra beside each
of them, which runs elsewhere and which tests compare with. See regnf_core/native/steps.h.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from regnf_core.native.library import Steps, variant

_MOST_NEAR = 64
"""As in near.h."""
_I64, _I32, _FLOAT, _ADDRESS = ctypes.c_int64, ctypes.c_int32, ctypes.c_float, ctypes.c_void_p


def _structure(name: str, **members: Any) -> type[ctypes.Structure]:
    return type(name, (ctypes.Structure,), {"_fields_": tuple(members.items())})


_Samples: Any = _structure(
    "Samples", poses=_I64, count=_I64, of_object=_I32, ahead=_FLOAT, min_cosine=_FLOAT, scale=_ADDRESS,
    rotation=_ADDRESS, translation=_ADDRESS, points=_ADDRESS, values=_ADDRESS, normals=_ADDRESS,
)  # fmt: skip
_Rows: Any = _structure(
    "Rows", total=_I64, first=_I64, values=_ADDRESS, jacobian=_ADDRESS, cosines=_ADDRESS, unobserved=_ADDRESS
)
_Observation: Any = _structure(
    "Observation", counts=_I64 * 3, states=_ADDRESS, turn=_FLOAT * 9, shift=_FLOAT * 3, ahead=_FLOAT, agreement=_FLOAT
)
_Planes: Any = _structure("Planes", cells=_I64, low=_FLOAT * 3, high=_FLOAT * 3, edge=_FLOAT * 3, planes=_ADDRESS)
_Loss: Any = _structure(
    "Loss", poses=_I64, total=_I64, scene_count=_I64, normals=_I32, with_offset=_I32, unobserved_width=_FLOAT,
    min_cosine=_FLOAT, values=_ADDRESS, cosines=_ADDRESS, widths=_ADDRESS, observed_weights=_ADDRESS,
    unobserved=_ADDRESS,
)  # fmt: skip


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


def samples(
    poses: Sequence[Tensor], points: Sequence[Tensor], of_object: bool, ahead: float, min_cosine: float
) -> Kept:
    """regnf_samples. poses: scale (H,), rotation (H, 3, 3), translation (H, 3) · points: those (N, 3), values (N,),
    normals (N, 3)."""
    parts = dict(zip(("scale", "rotation", "translation"), poses, strict=True))
    parts |= dict(zip(("points", "values", "normals"), points, strict=True))
    counts = {"poses": len(poses[0]), "count": len(points[0]), "of_object": of_object}
    return Kept(_Samples, **counts, ahead=ahead, min_cosine=min_cosine, **parts)


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


class Rows:
    """Room for the residuals of H poses at N + M samples, and what fills it."""

    def __init__(self, steps: Steps, poses: int, scene_count: int, total: int, partial: bool) -> None:
        """partial: not all was observed."""
        self._steps, self._scene_count, self._total = steps, scene_count, total
        self.values, self.cosines = torch.empty(2, poses, total)
        self.jacobian = torch.empty(poses, 7, total)
        self.unobserved = torch.empty(poses, total, dtype=torch.bool) if partial else None

    def fill(
        self, asked: Kept, of_object: bool, model: Any, seen: Kept | None = None, hidden: Tensor | None = None
    ) -> None:
        """The residuals of the samples ``asked`` in ``model``. seen: what tells what was not observed there · hidden:
        (N,) bool, see :class:`regnf_core.robust.working_frame.Samples`."""
        count, poses = len(asked.tensors["points"]), len(asked.tensors["scale"])
        places = torch.empty(poses * count, 3)
        self._steps.places(asked.address, places.data_ptr())
        value, gradient = (part.float() for part in model.value_and_gradient(places))
        # The code trusts their sizes, and a caller's own field may have any: reshape raises RuntimeError then.
        value, gradient = value.reshape(len(places)).contiguous(), gradient.reshape(len(places), 3).contiguous()
        hidden = None if hidden is None else hidden.contiguous()
        arrays = {"values": self.values, "jacobian": self.jacobian, "cosines": self.cosines}
        if self.unobserved is not None:
            arrays["unobserved"] = self.unobserved
        rows = Kept(_Rows, total=self._total, first=self._scene_count if of_object else 0, **arrays)
        self._steps.residuals(
            asked.address, value.data_ptr(), gradient.data_ptr(), rows.address, None if seen is None else seen.address,
            None if hidden is None else hidden.data_ptr(),
        )  # fmt: skip


def grid_distances(steps: Steps, grid: Kept, points: Tensor) -> tuple[Tensor, Tensor]:
    """Distance (M,) and gradient (M, 3) at points (M, 3)."""
    points = points.contiguous()
    value, gradient = torch.empty(len(points)), torch.empty(len(points), 3)
    steps.grid(grid.address, points.data_ptr(), len(points), value.data_ptr(), gradient.data_ptr())
    return value, gradient


def loss(
    values: Tensor, cosines: Tensor, scene_count: int, unobserved: Tensor | None, widths: Tensor,
    observed_weights: Tensor | None, normals: bool, with_offset: bool, unobserved_width: float, min_cosine: float,
) -> Kept:  # fmt: skip
    """regnf_loss. values, cosines, unobserved: (H, N + M) · widths, observed_weights: (H,)."""
    given = {"values": values, "cosines": cosines, "widths": widths}
    for name, one in (("unobserved", unobserved), ("observed_weights", observed_weights)):
        if one is not None:
            given[name] = one
    poses, total = values.shape
    return Kept(
        _Loss, poses=poses, total=total, scene_count=scene_count, normals=normals, with_offset=with_offset,
        unobserved_width=unobserved_width, min_cosine=min_cosine, **given,
    )  # fmt: skip


def costs(steps: Steps, of: Kept) -> Tensor:
    """(H,)."""
    found = torch.empty(len(of.tensors["values"]), dtype=torch.float64)
    steps.costs(of.address, found.data_ptr())
    return found.float()


def equations(steps: Steps, of: Kept, jacobian: Tensor, unknowns: int) -> tuple[Tensor, Tensor]:
    """J^T W J (H, K, K) and J^T W r (H, K), float64. jacobian: (H, 7, N + M), in one piece."""
    poses = len(of.tensors["values"])
    H, b = (
        torch.empty(poses, unknowns, unknowns, dtype=torch.float64),
        torch.empty(poses, unknowns, dtype=torch.float64),
    )
    steps.equations(of.address, jacobian.data_ptr(), H.data_ptr(), b.data_ptr())
    return H, b


def nearest(points: Tensor, places: Tensor, count: int) -> tuple[Tensor, Tensor] | None:
    """Distances (N, K) from places (N, 3) to the ``count`` nearest of points (M, 3), nearest first, and their numbers
    (N, K); None where there is no compiled code for it."""
    found = variant()
    if found is None or points.device.type != "cpu" or not 1 <= count <= min(_MOST_NEAR, len(points)):
        return None
    if not (torch.isfinite(points).all() and torch.isfinite(places).all()):
        return None
    of, at = points.double().contiguous(), places.cpu().double().contiguous()
    distance, number = torch.empty(len(at), count, dtype=torch.float64), torch.empty(len(at), count, dtype=torch.int64)
    if found.steps.nearest(
        of.data_ptr(), len(of), at.data_ptr(), len(at), count, distance.data_ptr(), number.data_ptr()
    ):
        raise MemoryError("no memory for a search of neighbors")
    return distance.to(places), number.to(places.device)


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
