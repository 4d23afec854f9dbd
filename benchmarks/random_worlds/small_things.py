"""Household things drawn at random: tableware, bottles, boxes, books, lamps, electronics. Meters, z up."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from benchmarks.random_worlds.mesh import Array, Mesh, ball, beam, block, box, disc, rod, together, tube, turned

_Rng = np.random.Generator


def mug(rng: _Rng) -> Mesh:
    """A cup with a handle."""
    radius, height, wall = rng.uniform(0.033, 0.05), rng.uniform(0.07, 0.13), rng.uniform(0.003, 0.006)
    low = radius * rng.uniform(0.7, 1.05)
    body = turned(_hollow([(low, 0.0), (radius, height)], wall))
    return together(body, _handle((radius + low) / 2.0 - wall / 2.0, height, rng.uniform(0.02, 0.035)))


def bottle(rng: _Rng) -> Mesh:
    """A bottle, a flask or a thermos."""
    radius, height = rng.uniform(0.027, 0.05), rng.uniform(0.16, 0.34)
    neck, shoulder, cap = radius * rng.uniform(0.3, 0.9), rng.uniform(0.45, 0.8), rng.uniform(0.015, 0.06)
    profile = [(radius * rng.uniform(0.85, 1.0), 0.0), (radius, 0.06 * height), (radius, shoulder * height)]
    profile += [(neck, (shoulder + 0.5 * (1.0 - shoulder)) * height), (neck, height - cap)]
    wide = neck * rng.uniform(1.0, 1.3)
    body = turned([(0.0, 0.0), *profile, (wide, height - cap), (wide, height), (0.0, height)])
    if rng.random() < 0.25:
        return together(body, _handle(radius - 0.004, shoulder * height, rng.uniform(0.025, 0.04)))
    return body


def bowl(rng: _Rng) -> Mesh:
    """A bowl, a plate or a dish."""
    radius = rng.uniform(0.06, 0.15)
    height, wall, foot = radius * rng.uniform(0.12, 0.75), rng.uniform(0.003, 0.008), rng.uniform(0.4, 0.6)
    curve = [
        (radius * (foot + (1.0 - foot) * math.sin(a)), height * (1.0 - math.cos(a)))
        for a in np.linspace(0, math.pi / 2, 6).tolist()
    ]
    return turned(_hollow(curve, wall))


def glass(rng: _Rng) -> Mesh:
    """A glass with a stem, a tumbler or a candlestick."""
    radius, height = rng.uniform(0.028, 0.045), rng.uniform(0.09, 0.24)
    if rng.random() < 0.4:
        return turned(_hollow([(radius * rng.uniform(0.7, 1.0), 0.0), (radius, height)], 0.003))
    stem = rng.uniform(0.4, 0.6) * height
    cup = turned(_hollow([(0.006, 0.0), (radius, 0.4 * (height - stem)), (0.9 * radius, height - stem)], 0.003))
    foot = turned([(0.0, 0.0), (0.9 * radius, 0.0), (0.006, 0.01), (0.005, stem + 0.004), (0.0, stem + 0.004)])
    return together(foot, cup.shifted(0.0, 0.0, stem))


def carton(rng: _Rng) -> Mesh:
    """A box, a parcel or a carton with a gable."""
    x, y, z = np.sort(rng.uniform(0.04, 0.3, 3))[rng.permutation(3)].tolist()
    body = block((0.0, 0.0, z / 2.0), (x, y, z))
    if rng.random() < 0.3:
        ridge = block((0.0, 0.0, z + 0.02), (x, 0.008, 0.045))
        slope = [beam((0.0, s * y / 2.0, z - 0.003), (0.0, 0.0, z + 0.03), x, 0.005) for s in (-1, 1)]
        return together(body, ridge, *slope)
    if rng.random() < 0.4:  # a lid that overlaps
        return together(body, block((0.0, 0.0, z - 0.01), (x + 0.01, y + 0.01, rng.uniform(0.02, 0.05))))
    return body


def can(rng: _Rng) -> Mesh:
    """A tin or a jar with a lid."""
    radius, height = rng.uniform(0.03, 0.06), rng.uniform(0.05, 0.18)
    rim = rng.uniform(0.0, 0.006)
    return turned([
        (0.0, 0.0), (radius, 0.0), (radius, 0.8 * height), (radius + rim, 0.8 * height), (radius + rim, height),
        (0.0, height),
    ])  # fmt: skip


def books(rng: _Rng) -> Mesh:
    """A book, or several in a pile that is not neat."""
    parts, level = [], 0.0
    for _ in range(int(rng.integers(1, 5))):
        wide, deep, thick = rng.uniform(0.12, 0.22), rng.uniform(0.18, 0.3), rng.uniform(0.012, 0.045)
        cover = 0.003
        pages = block((-cover, 0.0, level + thick / 2.0), (wide - 2.0 * cover, deep - 0.01, thick - 0.002))
        lids = [block((0.0, 0.0, level + z), (wide, deep, cover)) for z in (cover / 2.0, thick - cover / 2.0)]
        spine = box((wide / 2.0 - cover, -deep / 2.0, level), (wide / 2.0, deep / 2.0, level + thick))
        turn = _about_z(rng.normal(scale=0.15))
        turn[:2, 3] = rng.normal(scale=0.008, size=2)
        parts.append(together(pages, *lids, spine).moved(turn))
        level += thick - 0.0005
    return together(*parts)


def keyboard(rng: _Rng) -> Mesh:
    """A keyboard: rows of keys on a slab that slopes a little."""
    wide, deep, thick = rng.uniform(0.28, 0.46), rng.uniform(0.11, 0.17), rng.uniform(0.008, 0.02)
    parts = [block((0.0, 0.0, thick / 2.0), (wide, deep, thick))]
    rows, columns = int(rng.integers(4, 7)), int(rng.integers(12, 18))
    step = np.array([wide / (columns + 0.5), deep / (rows + 0.4)])
    for row in range(rows):
        column = 0.0
        while column < columns - 0.5:
            span = 1.0 if rng.random() < 0.85 else float(rng.choice([1.5, 2.0, 4.0]))
            span = min(span, columns - column)
            x = (column + span / 2.0 - columns / 2.0) * step[0]
            y = (row + 0.5 - rows / 2.0) * step[1]
            parts.append(block((x, y, thick + 0.003), (span * step[0] - 0.003, step[1] - 0.003, 0.008)))
            column += span
    return together(*parts)


def monitor(rng: _Rng) -> Mesh:
    """A flat screen on a stand."""
    wide = rng.uniform(0.4, 0.7)
    high, thick, up = wide * rng.uniform(0.5, 0.65), rng.uniform(0.015, 0.05), rng.uniform(0.05, 0.15)
    screen = block((0.0, 0.0, up + high / 2.0), (wide, thick, high))
    bezel = block((0.0, -thick / 2.0, up + 0.01), (wide, 0.012, 0.025))
    back = block((0.0, thick, up + high / 2.0), (0.4 * wide, 1.5 * thick, 0.4 * high))
    post = beam((0.0, thick * 1.2, 0.0), (0.0, thick * 1.2, up + high / 2.0), 0.06, 0.02)
    foot = rng.uniform(0.18, 0.3)
    if rng.random() < 0.5:
        base = disc((0.0, thick, 0.0), (foot / 2.0, foot / 2.5), 0.015)
    else:
        base = block((0.0, thick, 0.006), (foot, 0.75 * foot, 0.012))
    return together(screen, bezel, back, post, base)


def laptop(rng: _Rng) -> Mesh:
    """An open laptop."""
    wide, deep, thick = rng.uniform(0.28, 0.38), rng.uniform(0.19, 0.26), rng.uniform(0.012, 0.022)
    angle = rng.uniform(0.1, 0.6)
    hinge = np.array([0.0, deep / 2.0 - 0.004, thick - 0.004])
    tip = hinge + deep * np.array([0.0, math.sin(angle), math.cos(angle)])
    base = block((0.0, 0.0, thick / 2.0), (wide, deep, thick))
    return together(base, beam(hinge.tolist(), tip.tolist(), wide, 0.008))


def lamp(rng: _Rng) -> Mesh:
    """A table lamp with a shade, or a desk lamp with a jointed arm."""
    if rng.random() < 0.55:
        height, radius = rng.uniform(0.3, 0.6), rng.uniform(0.09, 0.18)
        stand = rng.uniform(0.4, 0.65) * height
        levels = np.linspace(0.0, stand, int(rng.integers(3, 8)))
        swell = rng.uniform(0.015, 0.07, len(levels))
        swell[0], swell[-1] = rng.uniform(0.06, 0.1), 0.012
        body = turned([(0.0, 0.0), *zip(swell.tolist(), levels.tolist(), strict=True), (0.0, stand)])
        top = radius * rng.uniform(0.4, 1.0)
        shade = turned(
            [(radius, stand), (top, height), (top - 0.004, height), (radius - 0.004, stand), (radius, stand)]
        )
        stem = rod((0.0, 0.0, stand - 0.01), (0.0, 0.0, height - 0.03), 0.006)
        spokes = rod((-0.95 * top, 0.0, height - 0.03), (0.95 * top, 0.0, height - 0.03), 0.004)
        return together(body, shade, stem, spokes)
    base, arm = rng.uniform(0.07, 0.1), rng.uniform(0.2, 0.35)
    lean, reach = rng.uniform(0.2, 0.5), rng.uniform(0.15, 0.3)
    elbow = np.array([0.0, arm * math.sin(lean), arm * math.cos(lean) + 0.02])
    head = elbow + reach * np.array([0.0, -0.85, rng.uniform(0.1, 0.5)])
    cone = (
        turned([(0.0, 0.0), (0.065, 0.0), (0.025, 0.09), (0.0, 0.09)], 24).shifted(*head.tolist()).shifted(0, 0, -0.07)
    )
    line = tube(np.stack([[0.0, 0.0, 0.01], elbow, head]), 0.009)
    return together(disc((0.0, 0.0, 0.0), (base, base), 0.022), line, cone)


def vase(rng: _Rng) -> Mesh:
    """A vase of any outline, open at the top."""
    height, radius = rng.uniform(0.12, 0.4), rng.uniform(0.04, 0.1)
    levels = np.linspace(0.0, height, 12)
    waves = 1.0 + 0.35 * np.sin(rng.uniform(1.0, 2.6) * math.pi * levels / height + rng.uniform(0.0, 6.0))
    return turned(_hollow(list(zip((radius * waves).tolist(), levels.tolist(), strict=True)), 0.006))


def plant(rng: _Rng) -> Mesh:
    """Leaves on stems in a pot."""
    radius, height = rng.uniform(0.05, 0.12), rng.uniform(0.08, 0.2)
    parts = [
        turned(
            [
                (0.0, 0.0),
                (0.75 * radius, 0.0),
                (radius, height),
                (0.9 * radius, height),
                (0.85 * radius, 0.85 * height),
                (0.0, 0.85 * height),
            ]
        )
    ]
    for _ in range(int(rng.integers(5, 12))):
        angle, lean, long = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(0.1, 0.9), rng.uniform(0.12, 0.35)
        out = np.array([math.cos(angle), math.sin(angle), 0.0])
        foot = 0.4 * radius * out + np.array([0.0, 0.0, 0.8 * height])
        bend = foot + 0.55 * long * (math.sin(lean) * out + math.cos(lean) * np.array([0.0, 0.0, 1.0]))
        tip = bend + 0.45 * long * (math.sin(1.6 * lean) * out + math.cos(1.6 * lean) * np.array([0.0, 0.0, 1.0]))
        wide = rng.uniform(0.02, 0.06)
        parts += [rod(foot.tolist(), bend.tolist(), 0.004, sides=6), beam(bend.tolist(), tip.tolist(), wide, 0.004)]
    return together(*parts)


def pot(rng: _Rng) -> Mesh:
    """A pot, a pan or a kettle, with a handle, two, or a spout as well."""
    radius, height = rng.uniform(0.07, 0.15), rng.uniform(0.04, 0.2)
    parts = [turned(_hollow([(0.92 * radius, 0.0), (radius, height)], 0.005))]
    kind = int(rng.integers(3))
    if kind == 0:
        parts.append(
            beam((radius - 0.01, 0.0, 0.8 * height), (radius + rng.uniform(0.12, 0.2), 0.0, 0.9 * height), 0.025, 0.014)
        )
    if kind == 1:
        for s in (-1.0, 1.0):
            parts.append(
                tube(
                    [
                        (s * (radius - 0.004), -0.03, 0.8 * height),
                        (s * (radius + 0.035), -0.03, 0.8 * height),
                        (s * (radius + 0.035), 0.03, 0.8 * height),
                        (s * (radius - 0.004), 0.03, 0.8 * height),
                    ],
                    0.007,
                )
            )
    if kind == 2:
        lid = turned([(0.0, 0.0), (radius, 0.0), (0.5 * radius, 0.03), (0.0, 0.035)]).shifted(0.0, 0.0, height - 0.002)
        spout = rod((0.9 * radius, 0.0, 0.4 * height), (1.5 * radius, 0.0, height), 0.018, 0.011)
        parts += [lid, ball((0.0, 0.0, height + 0.042), 0.013), spout]
        parts.append(_handle(-radius + 0.004, height, -rng.uniform(0.04, 0.06)))
    return together(*parts)


def blocks(rng: _Rng) -> Mesh:
    """A toy of blocks and rods stuck together: like nothing else."""
    parts = [block((0.0, 0.0, 0.03), rng.uniform(0.04, 0.15, 3).tolist())]
    for _ in range(int(rng.integers(2, 6))):
        host = parts[int(rng.integers(len(parts)))]
        low, high = host.bounds
        at = low + rng.random(3) * (high - low)
        if rng.random() < 0.7:
            parts.append(block(at.tolist(), rng.uniform(0.02, 0.12, 3).tolist()))
        else:
            out = rng.normal(size=3)
            parts.append(
                rod(
                    at.tolist(),
                    (at + rng.uniform(0.05, 0.14) * out / np.linalg.norm(out)).tolist(),
                    rng.uniform(0.008, 0.02),
                )
            )
    return together(*parts)


def tray(rng: _Rng) -> Mesh:
    """A tray, a basket or an open case."""
    x, y, z = rng.uniform(0.15, 0.4), rng.uniform(0.12, 0.3), rng.uniform(0.03, 0.2)
    wall = rng.uniform(0.005, 0.012)
    parts = [block((0.0, 0.0, wall / 2.0), (x, y, wall))]
    parts += [block((s * (x - wall) / 2.0, 0.0, z / 2.0), (wall, y, z)) for s in (-1, 1)]
    parts += [block((0.0, s * (y - wall) / 2.0, z / 2.0), (x, wall, z)) for s in (-1, 1)]
    if rng.random() < 0.4:
        parts.append(
            tube(
                [
                    (-x / 2.0 + 0.005, 0.0, z - 0.01),
                    (-x / 2.5, 0.0, z + 0.1),
                    (x / 2.5, 0.0, z + 0.1),
                    (x / 2.0 - 0.005, 0.0, z - 0.01),
                ],
                0.006,
            )
        )
    return together(*parts)


def tool(rng: _Rng) -> Mesh:
    """A hammer, a spoon, a brush: a handle with a head."""
    long, thick = rng.uniform(0.15, 0.32), rng.uniform(0.006, 0.018)
    handle = rod((0.0, 0.0, 0.02), (long, 0.0, 0.02), thick, thick * rng.uniform(0.7, 1.2))
    size = rng.uniform(0.02, 0.05, 3) * np.array([1.0, rng.uniform(1.0, 2.5), 1.0])
    if rng.random() < 0.5:
        return together(handle, block((long, 0.0, 0.02), size.tolist()))
    return together(handle, disc((long, 0.0, 0.012), (size[0], 0.7 * size[1]), 0.012))


SMALL: dict[str, Callable[[_Rng], Mesh]] = {
    made.__name__: made
    for made in (mug, bottle, bowl, glass, carton, can, books, keyboard, monitor, laptop, lamp, vase, plant, pot,
                 blocks, tray, tool)
}  # fmt: skip


def _hollow(outside: list[tuple[float, float]], wall: float) -> list[tuple[float, float]]:
    """The profile of a vessel with an outline from the foot to the rim, its wall as thick everywhere."""
    inside = [(max(r - wall, 0.001), max(z, wall)) for r, z in reversed(outside)]
    return [(0.0, outside[0][1]), *outside, *inside, (0.0, outside[0][1] + wall)]


def _handle(radius: float, height: float, out: float) -> Mesh:
    """A loop at the side of a vessel."""
    reach = math.copysign(abs(radius), out)
    line: Array = np.array(
        [
            (reach, 0.0, 0.78 * height),
            (reach + out, 0.0, 0.74 * height),
            (reach + out, 0.0, 0.3 * height),
            (reach, 0.0, 0.25 * height),
        ]
    )
    return tube(line, min(0.16 * abs(out) + 0.002, 0.008))


def _about_z(angle: float) -> Array:
    matrix = np.eye(4)
    matrix[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return matrix
