"""What a checkpoint itself says beside its large weights: whole numbers such as its step, and the tensors' shapes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.pickle.pickle_machine import Placeholder, TensorRef
from regnf_core.importing.tensor_source import TensorSource

_MAX_DEPTH, _MAX_VALUES = 4, 50_000
_MAX_NUMBER = 1 << 53


@dataclass(frozen=True)
class Facts:
    """Of one checkpoint. Tensors are called by the keys on the way to them, with dots between them."""

    numbers: Mapping[str, int] = field(default_factory=dict)
    tensors: Mapping[str, TensorRef] = field(default_factory=dict)
    objects: Mapping[str, Mapping[Any, Any]] = field(default_factory=dict)
    """Of objects at the top that are never made, the attributes that they would have had."""
    source: TensorSource | None = None

    def shape(self, end: str) -> tuple[int, ...] | None:
        """The shape of the one tensor whose keys end so; None where there is none, or several."""
        name = self._name(end)
        return None if name is None else tuple(self.tensors[name].shape)

    def weight(self, layer: str) -> tuple[int, ...] | None:
        """The shape of a linear layer's weights, normalized or not; None where it is no matrix."""
        shape = self.shape(f"{layer}.weight_v") or self.shape(f"{layer}.weight")
        return shape if shape is not None and len(shape) == 2 else None

    def few(self, end: str, most: int = 64) -> list[float] | None:
        """The numbers of the one tensor whose keys end so, if it is small and sound."""
        name = self._name(end)
        if name is None or self.source is None or self.tensors[name].storage.count > most:
            return None
        try:
            return [float(value) for value in self.source.array(name, self.tensors[name]).ravel()]
        except FieldFormatError:  # the family says it better, if it needs the tensor
            return None

    def count(self, part: str, end: str) -> int:
        """How many tensors there are with ``part`` in their keys that end so."""
        return sum(part in name and name.endswith(end) for name in self.tensors)

    def hidden_layers(self, part: str) -> int | None:
        """How many layers with a bias there are with ``part`` in their keys, but for the last; None without any."""
        layers = self.count(part, ".bias")
        return layers - 1 if layers else None

    def _name(self, end: str) -> str | None:
        found = [name for name in self.tensors if name == end or name.endswith("." + end)]
        return found[0] if len(found) == 1 else None


def facts_of(checkpoint: object, source: TensorSource | None = None) -> Facts:
    """What a checkpoint that was read says, as far as it is a dictionary; bounded in depth and number."""
    if not isinstance(checkpoint, dict):
        return Facts()
    numbers, objects = {}, {}
    for key, value in checkpoint.items():
        if isinstance(key, str) and isinstance(value, int) and not isinstance(value, bool) and 0 <= value < _MAX_NUMBER:
            numbers[key] = value
        if isinstance(key, str) and isinstance(value, Placeholder) and isinstance(value.state, dict):
            objects[key] = value.state
    return Facts(numbers, dict(_tensors(checkpoint)), objects, source)


def _tensors(checkpoint: Mapping[Any, Any]) -> Iterator[tuple[str, TensorRef]]:
    waiting: list[tuple[str, Mapping[Any, Any], int]] = [("", checkpoint, 0)]
    left = _MAX_VALUES
    while waiting:
        path, here, depth = waiting.pop()
        for key, value in here.items():
            left -= 1
            if left < 0:
                return
            if isinstance(key, str) and isinstance(value, TensorRef):
                yield path + key, value
            elif isinstance(key, str) and isinstance(value, dict) and depth < _MAX_DEPTH:
                waiting.append((f"{path}{key}.", value, depth + 1))


# Similarities between a field's frame and its dataset's, as 4 x 4 rows of plain numbers.

Rows = list[list[float]]
_TOLERANCE = 1e-4


def scaled_and_moved(scale: float, center: Sequence[float]) -> Rows:
    """x -> scale x + center."""
    rows = np.diag([scale, scale, scale, 1.0])
    rows[:3, 3] = center
    return _rows(rows)


def inverse_of(rows: Sequence[Sequence[float]], scale: float) -> Rows | None:
    """The inverse of x -> scale (R x + t) for ``rows`` of [R | t], 3 x 4; None where R is no rotation."""
    forward = np.eye(4)
    forward[:3] = np.array(rows, dtype=np.float64)
    forward[:3] *= scale
    if not is_similarity(forward):
        return None
    # Exact of a similarity, whatever the rounding of a general inverse.
    back = np.eye(4)
    back[:3, :3] = forward[:3, :3].T / np.cbrt(np.linalg.det(forward[:3, :3])) ** 2
    back[:3, 3] = -back[:3, :3] @ forward[:3, 3]
    return _rows(back)


def is_similarity(rows: Sequence[Sequence[float]] | np.ndarray) -> bool:
    """Whether the 4 x 4 rows are a rotation times one positive factor, and a shift."""
    matrix = np.array(rows, dtype=np.float64)
    linear = matrix[:3, :3]
    scale = np.cbrt(np.linalg.det(linear))
    if not (np.isfinite(matrix).all() and 1e-9 < scale < 1e9 and tuple(matrix[3]) == (0.0, 0.0, 0.0, 1.0)):
        return False
    if np.abs(linear).max() > 2.0 * scale:  # and its square may be more than a float can be
        return False
    return bool(np.allclose(linear @ linear.T, scale**2 * np.eye(3), rtol=0, atol=_TOLERANCE * scale**2))


def after_scaling(rows: Sequence[Sequence[float]], factor: float) -> Rows:
    """The similarity that first multiplies by ``factor``."""
    matrix = np.array(rows, dtype=np.float64)
    matrix[:3, :3] *= factor
    return _rows(matrix)


def _rows(matrix: np.ndarray) -> Rows:
    return [[float(value) for value in row] for row in matrix]
