"""Whether the depths of one surface agree from image to image, and which other convention they would agree by.

Files do not say which way a camera's axes point, whether a pose leads from the camera or to it, or what a depth is
measured along. The images say it: what one image saw at a place, another one that looks there sees at the same place,
or sees something before it. Only what lies before the other's surface contradicts it; what lies behind is hidden.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, permutations, product

import numpy as np
from numpy.typing import NDArray

from regnf_core.errors import DatasetError
from regnf_core.importing.observing.trajectory import rolled_quaternions
from regnf_data.posed_images import NO_TERMS, PosedImages, Terms

Floats = NDArray[np.float64]
Pixels = NDArray[np.int64]

_SAME = 0.05
"""Depths that differ by a larger share contradict each other: noise and drift of usual recordings are below."""
_PAIRS, _PIXELS = 300, 300
_ROUGH_PAIRS, _ROUGH_PIXELS = 60, 50
"""Pairs of images and pixels of each: to judge a convention, and to search among all."""
_SUSPECT = 0.25
"""Of the disagreement, from 0 to 1: below it nothing else is tried."""
_CLEAR = 0.5
"""Another convention leaves at most this share of the disagreement and of the contradictions, or it is no better."""
_FEWEST = 300
"""Places that two images saw, to say anything."""
_MOST_LEFT = 0.35
"""Of the disagreement, where a convention is said to be the right one."""
_NO_DOUBT = 0.07
"""Of places that contradict: good recordings of random worlds, of two to sixty images, have up to so many."""
_WARNED = 0.25
"""Of places that contradict, where no other convention makes them agree: several times as many as noise leaves."""
_ENOUGH = 5
"""Images that share nothing as they are: fewer agree by one of the many conventions and scales by chance."""
_BEYOND = 100.0
"""Times as large as the right depths: there shifts of the cameras count for nothing."""
_TRIED = 6
_MORE = 0.7
"""A second change is made where it leaves at most this share of what the first one left."""
_ROUNDS = 2
"""Conventions that are wrong at once, at most."""
_STEP = 0.08
_FACTORS = np.exp(_STEP * np.array([step for step in range(-115, 116) if abs(step) > 1]))
_UNITS = {0.001: "millimeters", 0.01: "centimeters", 0.0254: "inches", 0.3048: "feet", 0.0002: "steps of 1/5000"}
_STEPS = {0.2: "steps of 1/5000 that were read as 1/1000", 5.0: "steps of 1/1000 that were read as 1/5000"}
_NAMED = 0.04
_OPENGL = ((1, 0, 0), (0, -1, 0), (0, 0, -1))
_BODY = ((0, -1, 0), (0, 0, -1), (1, 0, 0))


@dataclass(frozen=True, eq=False)
class _Views:
    """What a convention makes of the images: depths (N, H, W), to be multiplied by ``factor``, intrinsics and poses.
    changes: what it takes for wrong in the dataset, and what mends that."""

    depths: NDArray[np.float32]
    intrinsics: Floats
    poses: Floats
    factor: float = 1.0
    changes: tuple[tuple[str, str], ...] = ()
    terms: Terms = NO_TERMS

    def because(self, wrong: str, mend: str) -> _Views:
        return replace(self, changes=(*self.changes, (wrong, mend)))

    def told(self) -> tuple[str, str]:
        """What is wrong, and what mends it."""
        changes = list(self.changes)
        if self.factor != 1.0:
            changes.append(_of_factor(self.factor, self.terms))
        mend = "; ".join(mend for _, mend in changes)
        return " and ".join(wrong for wrong, _ in changes), f"{mend[0].upper()}{mend[1:]}."


@dataclass(frozen=True)
class Agreement:
    """agreeing, contradicting: places that two images saw alike, and that one saw where the other looked through ·
    apart: the mean difference of the former, a share of the largest that they may have."""

    agreeing: int
    contradicting: int
    apart: float

    @property
    def places(self) -> int:
        return self.agreeing + self.contradicting

    @property
    def disagreement(self) -> float:
        """From 0 to 1: the mean difference, a share of the largest that counts as the same surface."""
        return (self.contradicting + self.apart * self.agreeing) / max(self.places, 1)

    def said(self) -> str:
        if self.places == 0:
            return "no two images show the same place"
        share = 100.0 * self.contradicting / self.places
        return f"of {self.places} surface points that two images show, {share:.2g} % are free space in the other image"

    @property
    def score(self) -> float:
        """Larger for conventions by which more places agree and fewer contradict."""
        return self.agreeing * (1.0 - self.apart) - self.contradicting


def score_of_scale(images: PosedImages, factor: float) -> float:
    """Larger where depths times ``factor`` agree better from image to image; 0 where images cannot tell."""
    if images.depths is None or (sample := _Sample.of(images.depths, _ROUGH_PAIRS, _ROUGH_PIXELS)) is None:
        return 0.0
    return sample.agreement(_Views(images.depths, images.intrinsics, images.T_world_camera, factor)).score


def check_views(depths: NDArray[np.float32], intrinsics: Floats, poses: Floats, terms: Terms) -> str | None:
    """As :func:`check_agreement`, of depths (N, H, W), intrinsics (N, 3, 3), poses (N, 4, 4), in a layout's words."""
    return _checked(_Views(depths, intrinsics, poses, terms=terms))


def check_agreement(images: PosedImages) -> str | None:
    """A warning where the images disagree by every convention; None where they agree, or cannot tell.

    Raises DatasetError (DATASET_FRAMES_DISAGREE) where they disagree, and agree by another convention.
    """
    if images.depths is None or len(images) < 2:
        return None
    depths = np.where(images.measured, images.depths, np.float32(0.0))
    return _checked(_Views(depths, images.intrinsics, images.T_world_camera, terms=images.terms))


def _checked(stated: _Views) -> str | None:
    if (sample := _Sample.of(stated.depths, _PAIRS, _PIXELS)) is None:
        return None
    found = sample.agreement(stated)
    if found.places >= _FEWEST and found.disagreement < _SUSPECT:
        return None
    # Poses that are all the same, as of a camera on a stand, agree or not by every convention.
    still = bool((np.ptp(stated.poses, axis=0) == 0.0).all())
    best, other = (stated, found) if still else _search(stated, sample)
    # A factor above 1 may be but a way to be rid of the cameras' places: beside depths that are large enough, shifts
    # count for nothing, and images of one distant wall agree by their turns alone.
    beyond = sample.agreement(replace(best, factor=_BEYOND * best.factor)).disagreement
    tells_depth = best.factor <= 1.0 or other.disagreement <= _CLEAR * beyond
    if best is not stated and tells_depth and _clearly_better(other, found, len(stated.poses)):
        wrong, mend = best.told()
        raise DatasetError(
            f"the images contradict each other: {found.said()}. With {wrong}: {other.said()}",
            reason="DATASET_FRAMES_DISAGREE",
            hint=mend,
        )
    if found.places < _FEWEST or found.contradicting < _WARNED * found.places:
        return None
    return f"FRAMES_DISAGREE: {found.said()}: poses, intrinsics or depths are wrong, or objects moved"


def _clearly_better(other: Agreement, found: Agreement, images: int) -> bool:
    """Whether images that agree as ``other`` says, by another convention, refute the one that ``found`` is of."""
    if other.agreeing < max(_FEWEST, found.agreeing) or other.disagreement > _MOST_LEFT:
        return False
    if found.places < _FEWEST:  # there is nothing to compare with: the other one must leave no doubt
        sure = other.disagreement < _SUSPECT and other.contradicting < _NO_DOUBT * other.places
        return sure and images >= _ENOUGH
    less = other.contradicting / other.places <= _CLEAR * found.contradicting / found.places
    return less and other.disagreement <= _CLEAR * found.disagreement


@dataclass(frozen=True, eq=False)
class _Sample:
    """Pairs of images (P,) and pixels (P, Q) of the first of each that have a depth."""

    first: Pixels
    second: Pixels
    row: Pixels
    column: Pixels

    @classmethod
    def of(cls, depths: NDArray[np.float32], pairs: int, pixels: int) -> _Sample | None:
        """Deterministic. None where fewer than two images have depths. Half of the pairs follow each other closely."""
        rng = np.random.default_rng(0)
        with_depth = np.flatnonzero((depths > 0.0).any(axis=(1, 2)))
        count = len(with_depth)
        if count < 2:
            return None
        first = rng.integers(count, size=pairs)
        steps = np.exp(rng.uniform(0.0, np.log(count), pairs)).astype(np.int64)  # small ones as often as large ones
        second = np.where(rng.random(pairs) < 0.5, rng.integers(count, size=pairs), (first + steps) % count)
        second = np.where(second == first, (first + 1) % count, second)
        first, second = with_depth[first], with_depth[second]
        rows, columns = np.zeros((pairs, pixels), np.int64), np.zeros((pairs, pixels), np.int64)
        for image in np.unique(first):
            measured = np.flatnonzero(depths[image] > 0.0)
            chosen = measured[rng.integers(len(measured), size=(int((first == image).sum()), pixels))]
            rows[first == image], columns[first == image] = np.divmod(chosen, depths.shape[2])
        return cls(first, second, rows, columns)

    def part(self, pairs: int, pixels: int) -> _Sample:
        return _Sample(self.first[:pairs], self.second[:pairs], self.row[:pairs, :pixels], self.column[:pairs, :pixels])

    def agreement(self, views: _Views) -> Agreement:
        """Of the pixels of the first images with what the second ones show there."""
        height, width = views.depths.shape[1:]
        depth = views.factor * views.depths[self.first[:, None], self.row, self.column].astype(np.float64)
        pixels = np.stack([self.column + 0.5, self.row + 0.5, np.ones(self.row.shape)], axis=-1)
        T = np.linalg.inv(views.poses[self.second]) @ views.poses[self.first]
        turn = T[:, :3, :3] @ np.linalg.inv(views.intrinsics[self.first])
        seen = np.einsum("pij,pqj->pqi", turn, pixels) * depth[..., None] + T[:, None, :3, 3]
        z = seen[..., 2]
        places = np.einsum("pij,pqj->pqi", views.intrinsics[self.second], seen)
        with np.errstate(all="ignore"):
            column, row = places[..., 0] / z, places[..., 1] / z
            shown = (z > 0.0) & (column >= 0) & (column < width) & (row >= 0) & (row < height) & (depth > 0.0)
        pair = np.nonzero(shown)[0]
        measured = views.depths[self.second[pair], row[shown].astype(np.int64), column[shown].astype(np.int64)]
        z, measured = z[shown][measured > 0.0], views.factor * measured[measured > 0.0]
        apart = z / measured - 1.0
        same = np.abs(apart) <= _SAME
        mean = float(np.abs(apart[same]).mean()) / _SAME if same.any() else 0.0
        return Agreement(int(same.sum()), int((apart < -_SAME).sum()), mean)


def _search(stated: _Views, sample: _Sample) -> tuple[_Views, Agreement]:
    """The convention by which the images agree best, of those that differ from the stated one in up to two objects."""
    rough = sample.part(_ROUGH_PAIRS, _ROUGH_PIXELS)
    best, found = stated, sample.agreement(stated)
    for _ in range(_ROUNDS):
        others = chain(_other_poses(best), _other_depths(best), _other_intrinsics(best))
        ranked = sorted(others, key=lambda views: -rough.agreement(views).score)[:_TRIED]
        judged = [(views, sample.agreement(views)) for views in ranked]
        views, agreement = max(judged, key=lambda one: one[1].score)
        for step in (_STEP / 2, _STEP / 4, _STEP / 8):  # factors are tried in coarse steps
            if views.factor != best.factor:
                near = [replace(views, factor=views.factor * float(np.exp(sign * step))) for sign in (-1, 0, 1)]
                views, agreement = max(((each, sample.agreement(each)) for each in near), key=lambda one: one[1].score)
        if agreement.score <= found.score or (
            best is not stated and agreement.disagreement > _MORE * found.disagreement
        ):
            break
        best, found = views, agreement
        if found.disagreement < _SUSPECT:
            break
    return best, found


def _other_poses(views: _Views) -> Iterator[_Views]:
    inverse = np.linalg.inv(views.poses)
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        axes = np.zeros((3, 3), np.int64)
        axes[list(order), range(3)] = signs
        if round(np.linalg.det(axes)) != 1:
            continue
        turn = np.eye(4)
        turn[:3, :3] = axes
        for inverted in (False, True):
            if inverted or not np.array_equal(axes, np.eye(3)):
                changed = replace(views, poses=(inverse if inverted else views.poses) @ turn)
                yield changed.because(*_of_axes(axes, inverted, views.terms))
    for step, wrong in ((-1, "quaternions with w first"), (1, "quaternions x y z w that were read with w first")):
        rolled = replace(views, poses=rolled_quaternions(views.poses, step))
        yield rolled.because(wrong, f"write the quaternions of {views.terms.poses} in the expected order")
    count = len(views.poses)
    by_name = np.argsort([str(number) for number in range(count)], kind="stable")
    orders = {
        "poses in reverse order": np.arange(count)[::-1],
        "poses in the order of names as text (1, 10, 11, 2)": by_name,
        "images in the order of names as text (1, 10, 11, 2)": np.argsort(by_name),
    }
    orders |= {f"poses {step:+d} images off": np.roll(np.arange(count), -step) for step in (-3, -2, -1, 1, 2, 3)}
    for name, order_of in orders.items():
        yield replace(views, poses=views.poses[order_of]).because(
            name, f"give each image its correct pose in {views.terms.poses}"
        )


def _of_axes(axes: Pixels, inverted: bool, terms: Terms) -> tuple[str, str]:
    """What is wrong with poses of such axes, and what mends it."""
    wrong, mend = [], []
    if inverted:
        ways = ["from the camera to the world", "from the world to the camera"]
        wrong.append(f"poses {ways[not terms.to_camera]}")
        mend.append(f"invert the matrices: {terms.poses} must map {ways[terms.to_camera]}")
    rows = tuple(tuple(int(number) for number in row) for row in axes)
    if rows == _OPENGL:
        other = "opengl" if terms.axes == "opencv" else "opencv"
        wrong.append(
            "cameras that look " + ("against z (OpenGL's axes)" if other == "opengl" else "along z (OpenCV's axes)")
        )
        mend.append(f"give --camera-axes {other}, or negate columns two and three of each camera-to-world pose")
    elif not np.array_equal(axes, np.eye(3)):
        named = ["+-"[int(column.sum() < 0)] + "xyz"[int(np.abs(column).argmax())] for column in axes.T]
        body = " (x forward, the body frame of a robot)" if rows == np.array(_BODY).T.tolist() else ""
        wrong.append(f"cameras whose right is {named[0]}, down {named[1]} and forward {named[2]}{body}")
        mend.append(
            f"rotate the axes of {terms.poses}: the columns of a camera-to-world pose are the camera's right, down "
            f"and forward"
        )
    return " and ".join(wrong), "; ".join(mend)


def _other_depths(views: _Views) -> Iterator[_Views]:
    rows, columns = np.indices(views.depths.shape[1:]) + 0.5
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
    one = len(views.intrinsics) if np.ptp(views.intrinsics, axis=0).any() else 1
    inverses = np.linalg.inv(views.intrinsics[:one])
    lengths = np.stack([np.linalg.norm(pixels @ inverse.T, axis=-1) for inverse in inverses]).astype(np.float32)
    along_rays = replace(views, depths=views.depths / lengths)
    yield along_rays.because(
        "distances along the rays", "depths are along the camera's axis: divide each by the length of its ray (x, y, 1)"
    )
    for flipped, name in ((views.depths[:, :, ::-1], "left and right"), (views.depths[:, ::-1], "top and bottom")):
        mirrored = replace(views, depths=flipped)
        yield mirrored.because(f"depth images with {name} swapped", f"mirror the depth images: {name}")
    for factor in _FACTORS:
        yield replace(views, factor=views.factor * float(factor))
    with np.errstate(divide="ignore"):
        inverse = np.where(views.depths > 0.0, 1.0 / views.depths, np.float32(0.0))
    of_inverse = replace(views, depths=inverse).because("inverse depths or disparities", "write depths")
    for factor in _FACTORS:
        yield replace(of_inverse, factor=float(factor))


def _of_factor(factor: float, terms: Terms) -> tuple[str, str]:
    """What is wrong where depths need a factor, and what mends it."""
    wrong = f"depths {factor:.3g} times as large"
    for known, name in (_UNITS | _STEPS).items():
        if abs(factor / known - 1.0) < _NAMED:
            factor, wrong = known, f"depths in {name}"
        elif known in _UNITS and abs(factor * known - 1.0) < _NAMED:
            factor, wrong = 1.0 / known, f"poses in {name}"
    unit = f"--depth-unit or {terms.unit}" if terms.unit else "--depth-unit"
    return wrong, f"multiply the depths, or their unit ({unit}), by {factor:.3g}; or divide the poses"


def _other_intrinsics(views: _Views) -> Iterator[_Views]:
    height, width = views.depths.shape[1:]
    K = views.intrinsics
    swapped = K[:, [1, 0, 2]][:, :, [1, 0, 2]]
    mend = f"write {views.terms.intrinsics} in pixels of these images"
    yield replace(views, intrinsics=swapped).because("intrinsics with width and height swapped", mend)
    middle = np.median(K[:, :2, 2], axis=0)
    fitting = {round(float(side / (2.0 * at)), 3) for side, at in zip((width, height), middle, strict=True) if at > 0.0}
    for factor in sorted(fitting | {0.25, 1.0 / 3.0, 0.5, 2.0, 3.0, 4.0}):
        if abs(factor - 1.0) > 0.02:
            scaled = K * np.array([[factor], [factor], [1.0]])
            text = f"intrinsics of images {1.0 / factor:.3g} times as large"
            yield replace(views, intrinsics=scaled).because(text, f"{mend}: times {factor:.3g}")
