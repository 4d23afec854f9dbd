"""Does a converted field behave like a signed distance field? It is evaluated once, for the report."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.fields.composite import near_origin
from regnf_core.fields.observation import SdfField
from regnf_core.importing.cost.mesh_work import ASKED_AGAIN, FACE_SHARE, FACES, NEAREST_SHARE, SAMPLES, STEPS
from regnf_core.surface.result_clouds import newton_step

# How the surface lies in a field's bounds: what tells a room from an object turned inside out, and from no object at
# all.
#
# An object stands in free space. A room's free space is enclosed, and fills most of what its surface encloses; that of
# an object turned inside out is the object itself, which fills little of its own convex hull.

_RIM = 0.05
"""This share of each edge of the bounds, at either end, is their rim."""
_ALL_ROUND = 0.95
"""More than this share of the bounds' faces inside matter: free space is enclosed."""
_FILLED = 0.4
"""Free space that fills less of its surface's convex hull is an object's; of furnished rooms it fills three
quarters."""
_MOSTLY = 0.9
"""More of the bounds inside matter leaves too little free space for a room."""
_TOUCHED = 0.02
"""More of the bounds' faces inside matter: the surface may be where the bounds cut it."""
_NEARER = 0.5
"""A distance below this share of that to the bounds is to a surface that is not at the bounds."""
INSIST = "the import option accept_implausible: true accepts it"


def measured_enclosure(
    points: Tensor, distance: Tensor, surface: Tensor, slope: float, box: tuple[Tensor, Tensor]
) -> dict[str, float]:
    """free_share_of_hull, inner_share_inside (without the rim), and inner_clearance: the least of the distances there,
    as a share of that to the bounds; 0 where all of it is matter.

    points: (N, 3) anywhere in the box · distance: (N,) there · surface: (M, 3) · slope: of the field at its surface ·
    box: lowest and highest corner.
    """
    low, high = box
    edge = high - low
    rim = torch.minimum(points - low, high - points)  # (N, 3)
    inner = (rim > _RIM * edge).all(dim=-1)
    inside = distance < 0
    free = inner & ~inside
    clearance = distance[free] / (slope * rim[free].amin(dim=-1))
    return {
        "free_share_of_hull": _free_share_of_hull(points, inside, surface),
        "inner_share_inside": float(inside[inner].float().mean()),
        "inner_clearance": float(clearance.min()) if len(clearance) else 0.0,
    }


def _free_share_of_hull(points: Tensor, inside: Tensor, surface: Tensor) -> float:
    """1 where the surface has no hull."""
    try:
        hull = ConvexHull(surface.double().numpy())
    except (QhullError, ValueError):  # flat, or of fewer points than a hull has
        return 1.0
    planes = torch.from_numpy(hull.equations).float()
    within = (points @ planes[:, :3].T + planes[:, 3]).amax(dim=-1) < 0
    return float((~inside[within]).float().mean()) if within.any() else 1.0


def require_sound_enclosure(measured: dict[str, float], sign: int | None) -> None:
    """Raise FieldFormatError (FIELD_IMPLAUSIBLE) for a field that is inside out, or has no surface but at its bounds.

    sign: the one that the values are read with, where nobody has said it; None: somebody has.
    """
    at_bounds, within = measured["share_inside_at_bounds"], measured["inner_share_inside"]
    if within == 1.0 and at_bounds > 0.5:
        raise _implausible(
            "everything except places at the bounds is inside solid matter: give bounds with free space around the "
            "surface, or the other sign"
        )
    if within == 0.0 and at_bounds > _TOUCHED and measured["inner_clearance"] > _NEARER:
        raise _implausible("it has a surface only at its bounds. The scale or the bounds may be wrong; give them")
    filled = measured["free_share_of_hull"]
    if sign is None or at_bounds <= _ALL_ROUND:
        return
    if filled < _FILLED or measured["share_inside"] > _MOSTLY:
        share = 100.0 * (1.0 - measured["share_inside"])
        enclosed = 100.0 * filled
        raise _implausible(
            f"it is solid matter everywhere at its bounds, and free space is {share:.0f} % of them and "
            f"{enclosed:.0f} % of"
            " the volume that its surface encloses: the object may be inside out. Give the import option sign:"
            f" {-sign} to invert it, or sign: {sign} if it is a correct room"
        )


def _implausible(what: str) -> FieldFormatError:
    return FieldFormatError(f"{what}; {INSIST}", reason="FIELD_IMPLAUSIBLE")


_SAME = 1e-3
"""Sums in another order give other last digits: by less than this share of the largest distance."""
_SURFACE_SHARE = 1e-3
"""A point counts as on the surface when its |distance| is below this share of the bounds' diagonal."""
_GRADIENT_RANGE = (0.5, 2.0)
_EVEN, _SCALED = 1.15, 0.15
"""Slopes that differ this little are those of distances in one unit; this far from 1, it is not the bounds' unit."""
_PLAUSIBLE = (0.1, 10.0)
"""Beyond these slopes distances are of no use. Trained fields are known from 0.2 (a loss that clamps them) to 2."""
_MIN_SLOPE = 1e-6  # a field of any unit may be uploaded: only a gradient of zero is left out; the steps are bounded


@contextmanager
def without_new_code() -> Iterator[None]:
    """Keep torch from oneDNN, which writes machine code for the processor at hand: the filter refuses such pages."""
    before = torch.backends.mkldnn.set_flags(_enabled=False)  # type: ignore[no-untyped-call]
    try:
        yield
    finally:
        torch.backends.mkldnn.set_flags(_enabled=before[0])  # type: ignore[no-untyped-call]


@without_new_code()
def check_plausibility(
    field: SdfField, samples: int = SAMPLES, seed: int = 0, is_mesh: bool = False
) -> tuple[dict[str, float], list[str], list[list[float]]]:
    """Measurements of the field, warnings, and the lowest and the highest corner of the surface, as points on it show.

    Measured: share_inside and share_inside_at_bounds (of the bounds' volume, of their faces), surface_points,
    gradient_p10, gradient_median and gradient_p90 (the gradient's norm there), and what ``measured_enclosure`` does.

    is_mesh: whether it was made from faces, which is for the words of an error alone.
    ``samples`` points are drawn uniformly in the bounds; the sixteenth of least |distance| walks down to the surface
    along the gradient.
    Raises FieldFormatError: FIELD_NOT_FINITE, FIELD_NOT_A_FUNCTION when a point's distance depends on which others are
    evaluated, or NO_ZERO_LEVEL when no point of the bounds lies on a surface.
    """
    field, origin = near_origin(field)
    lower, upper = field.bounds[0].float(), field.bounds[1].float()
    generator = torch.Generator().manual_seed(seed)
    points = lower + (upper - lower) * torch.rand(samples, 3, generator=generator)  # (N, 3)
    distance = field.signed_distance(points)
    _require_finite(distance)
    _require_function(field, points, distance)
    nearest = points[distance.abs().argsort()[: samples // NEAREST_SHARE]]
    surface, norms, signs = _walk_to_surface(field, nearest, (lower, upper))
    inside = distance < 0
    both_sides = bool(inside.any() or (signs < 0).any()) and bool((~inside).any() or (signs > 0).any())
    if not both_sides or norms.numel() == 0:
        raise _no_surface(distance, is_mesh)
    low, median, high = torch.quantile(norms, torch.tensor([0.1, 0.5, 0.9])).tolist()
    measured = {
        "share_inside": float(inside.float().mean()),
        "share_inside_at_bounds": _share_inside_at_bounds(field, (lower, upper), samples, generator),
        "surface_points": float(norms.numel()),
        "gradient_p10": low,
        "gradient_median": median,
        "gradient_p90": high,
        **measured_enclosure(points, distance, surface, median, (lower, upper)),
    }
    corners = torch.stack([surface.amin(0), surface.amax(0)]).double().cpu() + origin
    return measured, _warnings(measured), corners.tolist()


def _no_surface(distance: Tensor, is_mesh: bool) -> FieldFormatError:
    low, high = float(distance.min()), float(distance.max())
    if is_mesh:
        message = (
            f"the mesh encloses no volume: all {len(distance)} tested points in its bounds are free space. It may be "
            f"flat or double-sided, or very small with a part far away. Close it, or give it a thickness"
        )
        return FieldFormatError(message, reason="NO_ZERO_LEVEL")
    where = "free" if low > 0 else "inside matter" if high < 0 else "without a valid gradient"
    message = (
        f"the field has no surface within its bounds: all is {where}, with values from {low:.3g} to {high:.3g}; if"
        " the trained region has other bounds, give the import option bounds"
    )
    return FieldFormatError(message, reason="NO_ZERO_LEVEL")


def require_plausible(measured: dict[str, float], sign: int | None = None) -> None:
    """Raise FieldFormatError (FIELD_IMPLAUSIBLE) if what was measured is no signed distance's, not even a bad one's.

    sign: the one that the values are read with, where nobody has said it.
    """
    slope = measured["gradient_median"]
    if not _PLAUSIBLE[0] <= slope <= _PLAUSIBLE[1]:
        message = (
            f"the gradient's norm at the surface is {slope:.3g}, where a signed distance has 1: the config file may"
            f" belong to another file, or the values may not be distances; {INSIST}"
        )
        raise FieldFormatError(message, reason="FIELD_IMPLAUSIBLE")
    require_sound_enclosure(measured, sign)


def _require_function(field: SdfField, points: Tensor, distance: Tensor) -> None:
    """A few of the points once more, in another order and without the rest."""
    again = field.signed_distance(points[:ASKED_AGAIN].flip(0)).flip(0)
    _require_finite(again)
    if (again - distance[:ASKED_AGAIN]).abs().max() > _SAME * distance.abs().max():
        message = "the distance at a point depends on the other points of the batch"
        raise FieldFormatError(message, reason="FIELD_NOT_A_FUNCTION")


def _share_inside_at_bounds(
    field: SdfField, box: tuple[Tensor, Tensor], samples: int, generator: torch.Generator
) -> float:
    """Share of the bounds' faces, each counting alike, that lies inside matter."""
    each = samples // FACE_SHARE
    points = torch.rand(FACES, each, 3, generator=generator)
    for face in range(FACES):
        points[face, :, face // 2] = float(face % 2)
    distance = field.signed_distance(box[0] + (box[1] - box[0]) * points.view(-1, 3))
    _require_finite(distance)
    return float((distance < 0).float().mean())


def _walk_to_surface(field: SdfField, points: Tensor, box: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Where (M, 3) the walk ended on the surface, gradient norms (M,) there, and the signs (K,) met on the way.

    Newton steps of at most a twentieth of the diagonal, kept within the bounds.
    """
    diagonal = float((box[1] - box[0]).norm())
    signs = []
    for _ in range(STEPS):
        distance, gradient = _evaluate(field, points)
        signs.append(distance.sign())
        step = newton_step(distance, gradient, _MIN_SLOPE)
        too_long = (step.norm(dim=-1, keepdim=True) / (diagonal / 20)).clamp_min(1.0)
        points = torch.minimum(torch.maximum(points - step / too_long, box[0]), box[1])
    distance, gradient = _evaluate(field, points)
    signs.append(distance.sign())
    norms = gradient.norm(dim=-1)
    _require_finite(norms)  # its parts may be finite and their squares not
    # Where the gradient vanishes |distance| says nothing about how near the surface is.
    on_surface = (distance.abs() < _SURFACE_SHARE * diagonal * norms.clamp_max(1.0)) & (norms > 1e-6)
    return points[on_surface], norms[on_surface], torch.cat(signs)


def _evaluate(field: SdfField, points: Tensor) -> tuple[Tensor, Tensor]:
    distance, gradient = field.signed_distance_and_gradient(points)
    _require_finite(distance)
    _require_finite(gradient)
    return distance, gradient


def _require_finite(values: Tensor) -> None:
    if not torch.isfinite(values).all():
        raise FieldFormatError("the field evaluates to NaN or infinity", reason="FIELD_NOT_FINITE")


def _warnings(measured: dict[str, float]) -> list[str]:
    warnings = []
    low, median, high = (measured[f"gradient_{which}"] for which in ("p10", "median", "p90"))
    even = high < _EVEN * low and abs(median - 1.0) > _SCALED
    if even or not _GRADIENT_RANGE[0] <= median <= _GRADIENT_RANGE[1]:
        text = (
            f"the gradient's norm at the surface is {median:.2f}, not about 1: the family or the hash grid may be wrong"
        )
        warnings.append(f"GRADIENT_NOT_UNIT: {text}")
    if measured["share_inside"] > 0.9:
        text = (
            "more than 90 % of the bounds are inside solid matter. If the sign is inverted, give the import "
            "option sign: -1"
        )
        warnings.append(f"MOSTLY_INSIDE: {text}")
    return warnings
