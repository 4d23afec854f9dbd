"""Parts of a mesh whose faces look into them, while those of the rest face free space: they would be no matter.

Free space has the same generalized winding number everywhere, and matter has more. Less than that of free space is
found within such a part alone: a leg of a chair that was mirrored, a blade that was exported the wrong way round.
Only parts that are closed, or nearly so, can tell: sheets that were scanned from one side may face each other.
"""

from __future__ import annotations

from collections.abc import Callable

import igl
import numpy as np
import numpy.typing as npt

from regnf_core.importing.families.facing import INWARD
from regnf_core.importing.families.winding import areas, places_before, winding_number
from regnf_core.importing.meshes.geometry import Float64Array, Int64Array

BoolArray = npt.NDArray[np.bool_]
_MOST = 300
"""Parts that are looked at, the largest ones."""
_PLACES = 9
"""On each of them, where the winding number is asked for."""
_CLOSED = -0.9
"""A part is closed, or nearly so, and looks into itself, if the median winding number of its own faces, at the places
before them, is below this."""
_FEW = 0.002
"""Share of the area: less is not worth a change."""
_ROUNDS = 2
"""A part within another is told only when the other one is right."""
PLACES = _MOST * _PLACES * (2 * _ROUNDS + 1)
"""At most so many winding numbers are asked for."""


def facing_outward(vertices: Float64Array, faces: Int64Array, free: float) -> tuple[Int64Array, tuple[str, ...]]:
    """The faces (F, 3), those of parts that look into themselves turned round, and what was done.

    vertices: (V, 3) · free: the winding number of free space. A part is a patch of faces that agree with each other.
    """
    part = np.asarray(igl.bfs_orient(np.ascontiguousarray(faces))[1]).reshape(-1)
    area = areas(vertices, faces)
    sizes = np.bincount(part, area)
    if len(sizes) == 1:
        return faces, ()
    looked_at = np.argsort(-sizes, kind="stable")[:_MOST]
    drawn = _drawn(part, area, looked_at)

    def with_turned(turned: BoolArray) -> Int64Array:
        return np.where(turned[part][:, None], faces[:, ::-1], faces)

    def inward(turned: BoolArray) -> BoolArray:
        found = np.zeros(len(sizes), bool)
        found[looked_at] = _before(vertices, with_turned(turned), drawn) < free + INWARD
        return found

    turned = _to_turn(inward, len(sizes))
    for number, chosen in zip(looked_at, drawn, strict=True):
        if turned[number]:
            places = places_before(vertices, faces, chosen, np.random.default_rng(1))
            own = winding_number(vertices, faces[part == number], places)
            turned[number] = np.median(own) < _CLOSED
    share = float(sizes[turned].sum() / sizes.sum())
    if share <= _FEW:
        return faces, ()
    told = f"{100.0 * share:.2g} % of its surface was turned round: parts whose faces looked into them"
    return with_turned(turned), (told,)


def _to_turn(inward: Callable[[BoolArray], BoolArray], count: int) -> BoolArray:
    """Which of so many parts to turn; what looks inward either way stays. inward: of the parts, with these turned."""
    turned, tried = np.zeros(count, bool), np.zeros(count, bool)
    found = inward(turned)
    for _ in range(_ROUNDS):
        wrong = found & ~tried
        if not wrong.any():
            break
        tried |= wrong
        found = inward(turned ^ wrong)
        useless = wrong & found
        turned ^= wrong & ~useless
        if useless.any():
            found = inward(turned)
    return turned


def _drawn(part: Int64Array, area: Float64Array, looked_at: Int64Array) -> Int64Array:
    """(P, K): numbers of faces of each part that is looked at, uniform over its area."""
    order = np.argsort(part, kind="stable")
    reached = np.cumsum(area[order])
    sizes = np.bincount(part, area)
    start = np.cumsum(sizes) - sizes
    aimed = start[looked_at, None] + sizes[looked_at, None] * np.random.default_rng(0).random((len(looked_at), _PLACES))
    found: Int64Array = order[np.searchsorted(reached, aimed).clip(max=len(order) - 1)]
    return found


def _before(vertices: Float64Array, faces: Int64Array, drawn: Int64Array) -> Float64Array:
    """(P,): the median winding number before the drawn faces (P, K) of each part."""
    places = places_before(vertices, faces, drawn.reshape(-1), np.random.default_rng(1))
    median: Float64Array = np.median(winding_number(vertices, faces, places).reshape(drawn.shape), axis=1)
    return median
