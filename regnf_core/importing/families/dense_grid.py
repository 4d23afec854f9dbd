"""A dense grid of signed distances as .npz: regnf's own convention for fields of trainers that it does not know.

``sdf`` (X, Y, Z), the first axis x; node (i, j, k) is at ``origin`` + ``spacing`` (i, j, k). See docs/families.md.
"""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, StoredArray, require_shape, tensor_error
from regnf_core.importing.assumptions import GRID, UNSAID
from regnf_core.importing.containers.euclidean import (
    PROJECTIVE,
    bound_by_surface,
    doubts_of_map,
    filled_nodes,
    stored_weights,
)
from regnf_core.importing.containers.npz import ArraySource
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import entries_at, refuse_other_entries, require_family, shared_entries
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.similarity import local_origin

FAMILY = "dense_sdf_grid"
_VALUES = ("sdf", "values")
_WEIGHTS = ("weight", "weights")
_SPACINGS = ("spacing", "voxel_size")
_Vector = npt.NDArray[np.float64]
_NEAREST, _COMPARED = 0.2, 4_000
"""The slopes are compared at about so many nodes, of this share that is nearest to the surface."""
_UNEVEN = 0.05
"""Slopes that differ by less are those of distances; so far from 1, these are not in the unit of the spacing."""
_STEEP, _JUMPING = 1.5, 0.1
"""Values of so large a share of the neighbors that differ by so many times their distance are no distances."""
_OFF = 0.1
"""Slopes that are this near to 1, in the median, leave no doubt about the axes."""


def convert(arrays: ArraySource, overrides: UploadDescription) -> ConvertedField | None:
    """The grid in ``arrays``, or None where there is no array ``sdf`` or ``values``.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, INVALID_DESCRIPTION, TENSOR_MISSING, TENSOR_SHAPE, BOUNDS_INVALID and
    what ArraySource raises.
    """
    name = next((name for name in _VALUES if name in arrays), None)
    if name is None:
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY)
    values = arrays.array(name)
    require_shape(name, values, (None, None, None))
    if min(values.shape) < 2:
        raise tensor_error(f"{name} has shape {values.shape}, expected at least two nodes per axis", "TENSOR_SHAPE")
    weights = _weights(arrays, values.shape)
    origin, spacing, told = _placement(arrays, np.array(values.shape))
    why = (f"array {name}, {' x '.join(map(str, values.shape))} nodes", f"placed by {told}; the first axis is x")
    return grid_field(values, origin, spacing, why, overrides, weights)


def grid_field(
    values: Float32Array,
    origin: _Vector,
    spacing: _Vector,
    why: tuple[str, ...],
    overrides: UploadDescription,
    weights: Float32Array | None = None,
) -> ConvertedField:
    """The field of values (X, Y, Z) at ``origin`` (3,) + ``spacing`` (3,) * (i, j, k). weights: 0 where none was seen.

    Raises FieldFormatError (BOUNDS_INVALID).
    """
    if not (np.isfinite(origin).all() and np.isfinite(spacing).all() and (spacing > 0.0).all()):
        raise _invalid("the spacing of the grid must be positive along every axis, and its origin must be finite")
    tensors: dict[str, StoredArray] = {"values": values}
    if weights is not None:
        tensors["weights"] = stored_weights(weights)
    box = [origin.tolist(), (origin + spacing * (np.array(values.shape) - 1)).tolist()]
    shift = local_origin(box)
    description = {
        "kind": "voxel_grid",
        **entries_at(shared_entries(overrides, box), shift),
        "origin": (origin if shift is None else origin - np.array(shift)).tolist(),
        "spacing": spacing.tolist(),
        "source": {"family": FAMILY},
    }
    seen = None if weights is None else weights > 0
    warnings = _other_axes(values, spacing, seen)
    if seen is None:
        warnings = (*warnings, *_jumps(values, spacing))
    else:
        one = np.zeros((1, 3), np.int64)
        warnings = (*warnings, *doubts_of_map(values[None], seen[None], one, spacing))
        tensors["values"] = bounded = np.array(values, np.float32)
        if bound_by_surface(bounded[None], seen[None], one, spacing):
            why = (*why, PROJECTIVE)
    if seen is not None and not seen.all():
        tensors["values"] = filled_nodes(bounded, seen, spacing, overrides.sign or 1)
        why = (
            *why,
            f"{100.0 * float(seen.mean()):.3g} % of the nodes were observed; the others are free space",
        )
    return ConvertedField(FAMILY, why, description, tensors, warnings, sign_is_open=True, assumes=(*UNSAID, GRID))


@np.errstate(all="ignore")
def _other_axes(values: Float32Array, spacing: _Vector, seen: npt.NDArray[np.bool_] | None) -> tuple[str, ...]:
    """A warning where distances rise by one a unit only if the array's axes are others than x, y, z."""
    inner = np.abs(values[1:-1, 1:-1, 1:-1])
    if np.ptp(spacing) <= 1e-6 * spacing.max() or not inner.size:
        return ()
    near = inner <= np.quantile(inner, _NEAREST)
    if seen is not None:
        near &= seen[1:-1, 1:-1, 1:-1]
    at = np.argwhere(near)[:: max(1, int(near.sum()) // _COMPARED)] + 1  # (N, 3)
    if not len(at):
        return ()
    off: dict[str, float] = {}
    for order in itertools.permutations(range(3)):  # the array's axis i lies along order[i]
        slopes = _slopes(values, spacing, at, order)
        off["".join("xyz"[axis] for axis in order)] = float(np.median(np.abs(slopes - 1.0)))
    best = min(off, key=lambda name: off[name])
    if off["xyz"] < _OFF or off[best] > off["xyz"] / 3.0:
        return ()
    text = (
        f"the distances fit the spacing better if the array's axes are {', '.join(best)}; they were read as x, y, z. "
        f"Transpose the array if that is wrong"
    )
    return (f"AXES_UNCERTAIN: {text}",)


@np.errstate(all="ignore")
def _jumps(values: Float32Array, spacing: _Vector) -> tuple[str, ...]:
    """A warning of values that neighbors cannot have, if they are distances in the unit of the spacing."""
    word = "GRADIENT_NOT_UNIT: the values "
    if len(np.unique(values.reshape(-1)[:_COMPARED])) <= 2 and len(np.unique(values)) <= 2:
        return (f"{word}are two alone: they say what is inside, and not how far away it is",)
    apart = (np.abs(np.diff(values, axis=axis)) > _STEEP * step for axis, step in enumerate(spacing))
    share = max(float(one.mean()) for one in apart)
    if share > _JUMPING:
        text = f"of {100 * share:.0f} % of the neighbors differ by more than {_STEEP:g} times their distance"
        return (f"{word}{text}: check the array's shape and order",)
    if min(values.shape) <= 2:
        return ()
    at = np.random.default_rng(0).integers(1, np.array(values.shape) - 1, (_COMPARED, 3))
    middle, high = np.quantile(_slopes(values, spacing, at, (0, 1, 2)), [0.5, 0.9])
    even = high < (1.0 + _UNEVEN) * middle and abs(high - 1.0) > _UNEVEN
    text = f"rise by {high:.3g} a unit almost everywhere: they or the spacing are of another unit"
    return (f"{word}{text}",) if even else ()


def _slopes(values: Float32Array, spacing: _Vector, at: npt.NDArray[np.int64], order: tuple[int, ...]) -> _Vector:
    """(N,) slopes at inner nodes (N, 3), if the array's axis i lies along order[i]."""
    steps = np.eye(3, dtype=np.int64)
    rises = [(values[tuple((at + one).T)] - values[tuple((at - one).T)]).astype(np.float64) / 2.0 for one in steps]
    squares = [(rise / spacing[axis]) ** 2 for rise, axis in zip(rises, order, strict=True)]
    return np.asarray(np.sqrt(sum(squares)), np.float64)


def _weights(arrays: ArraySource, shape: tuple[int, ...]) -> Float32Array | None:
    """How much was seen of each node, where an array says so."""
    name = next((name for name in _WEIGHTS if name in arrays), None)
    if name is None:
        return None
    weights = arrays.weights(name)
    require_shape(name, weights, shape)
    if not weights.any():
        raise tensor_error(f"no node was observed: all of {name} is zero", "TENSOR_SHAPE")
    return weights


def _placement(arrays: ArraySource, nodes: npt.NDArray[np.int64]) -> tuple[_Vector, _Vector, str]:
    """The first node's place, the spacing along each axis, and the arrays that told."""
    given = [name for name in ("origin", "bounds") if name in arrays]
    if len(given) != 1:
        raise _invalid("either origin and spacing or bounds place a grid; there are " + (" and ".join(given) or "none"))
    if given == ["bounds"]:
        low, high = _vector(arrays, "bounds", (2, 3))
        spacing, told = (high - low) / (nodes - 1), "bounds"
    else:
        name = next((name for name in _SPACINGS if name in arrays), _SPACINGS[0])
        low, spacing, told = _vector(arrays, "origin", (3,)), _steps(arrays, name), f"origin and {name}"
    return low, spacing, told


def _steps(arrays: ArraySource, name: str) -> _Vector:
    steps = arrays.numbers(name)
    if steps.size == 1:
        return np.full(3, float(steps.reshape(())))
    return _vector(arrays, name, (3,))


def _vector(arrays: ArraySource, name: str, shape: tuple[int, ...]) -> _Vector:
    vector = arrays.numbers(name)
    if vector.shape != shape:
        raise tensor_error(f"{name} has shape {vector.shape}, expected {shape}", "TENSOR_SHAPE")
    return vector


def _invalid(message: str) -> FieldFormatError:
    return FieldFormatError(message, reason="BOUNDS_INVALID")
