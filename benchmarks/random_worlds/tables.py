"""Tables, desks, shelves and cabinets drawn at random. Meters, z up; fronts look along -y."""

from __future__ import annotations

import math

import numpy as np

from benchmarks.random_worlds.mesh import Mesh, ball, beam, block, box, disc, rod, together, turned

_SIGNS = ((-1, -1), (-1, 1), (1, -1), (1, 1))


def table(rng: np.random.Generator, size: tuple[float, float] | None = None) -> Mesh:
    """A low, a dining or a side table; size: of the top, None for any."""
    kind = str(rng.choice(["low", "dining", "side"]))
    width, depth, height = {
        "low": (rng.uniform(0.7, 1.3), rng.uniform(0.45, 0.8), rng.uniform(0.3, 0.5)),
        "dining": (rng.uniform(0.9, 1.7), rng.uniform(0.65, 0.95), rng.uniform(0.68, 0.78)),
        "side": (rng.uniform(0.35, 0.6), rng.uniform(0.3, 0.55), rng.uniform(0.45, 0.7)),
    }[kind]
    if size is not None:
        width, depth, height = *size, rng.uniform(0.45, 0.8)
    thick, round_top = rng.uniform(0.015, 0.05), rng.random() < 0.3
    if round_top:
        top = disc((0.0, 0.0, height - thick), (width / 2.0, width / 2.0 if rng.random() < 0.5 else depth / 2.0), thick)
        depth = min(width, depth)
    else:
        top = block((0.0, 0.0, height - thick / 2.0), (width, depth, thick))
    under = height - thick + 0.002
    style = str(rng.choice(["square", "turned", "splayed", "pedestal", "trestle", "panels"]))
    inset = 0.3 if round_top else rng.uniform(0.02, 0.12)
    x, y = width / 2.0 * (1.0 - inset), depth / 2.0 * (1.0 - inset)
    parts = [top, *_supports(rng, style, (x, y), under)]
    if style in ("square", "turned"):
        if rng.random() < 0.6:
            parts += _skirt(rng, (x, y), under)
        if rng.random() < 0.25:
            level = rng.uniform(0.1, 0.5) * height
            parts.append(block((0.0, 0.0, level), (2.0 * x, 2.0 * y, 0.016)))
    if not round_top and rng.random() < 0.25:
        parts += _drawers(rng, (0.35 * width, 0.8 * depth), (under - 0.14, under), 1)
    return together(*parts)


def desk(rng: np.random.Generator) -> Mesh:
    """A desk with a pedestal of drawers on one side and a panel or legs on the other."""
    width, depth, height = rng.uniform(1.0, 1.6), rng.uniform(0.5, 0.75), rng.uniform(0.7, 0.77)
    thick, x, y = rng.uniform(0.018, 0.035), width / 2.0, depth / 2.0
    side = 1.0 if rng.random() < 0.5 else -1.0
    wide = rng.uniform(0.3, 0.45)
    count = int(rng.integers(2, 5))
    parts = [block((0.0, 0.0, height - thick / 2.0), (width, depth, thick))]
    chest = _drawers(rng, (wide, depth - 0.04), (0.05, height - thick + 0.002), count)
    parts += [part.shifted(side * (x - wide / 2.0 - 0.02), 0.0, 0.0) for part in chest]
    parts.append(box((side * (x - 0.02) - 0.01, -y + 0.03, 0.0), (side * (x - 0.02) + 0.01, y - 0.03, 0.06)))
    parts.append(box((side * (x - wide) - 0.01, -y + 0.03, 0.0), (side * (x - wide) + 0.01, y - 0.03, 0.06)))
    other = -side * (x - 0.03)
    if rng.random() < 0.5:
        parts.append(block((other, 0.0, (height - thick) / 2.0), (0.022, depth - 0.04, height - thick + 0.004)))
    else:
        parts += [
            rod((other, s * (y - 0.05), 0.0), (other, s * (y - 0.05), height - thick + 0.002), 0.02) for s in (-1, 1)
        ]
    if rng.random() < 0.5:
        parts.append(box((-x + 0.02, y - 0.05, 0.3), (x - 0.02, y - 0.035, height - thick + 0.002)))
    return together(*parts)


def shelf(rng: np.random.Generator, size: tuple[float, float, float] | None = None) -> Mesh:
    """Boards between two sides, perhaps with a back and uprights."""
    width, depth, height = size or (rng.uniform(0.5, 1.3), rng.uniform(0.24, 0.42), rng.uniform(0.6, 2.0))
    thick, x, y = rng.uniform(0.014, 0.03), width / 2.0, depth / 2.0
    levels = np.linspace(rng.uniform(0.0, 0.12), height - thick, max(2, round(height / rng.uniform(0.27, 0.42)) + 1))
    parts = [box((-x + 0.004, -y, z), (x - 0.004, y, z + thick)) for z in levels.tolist()]
    if rng.random() < 0.75:
        parts += [box((s * x - (s > 0) * thick, -y, 0.0), (s * x + (s < 0) * thick, y, height)) for s in (-1, 1)]
    else:
        slim = rng.uniform(0.015, 0.03)
        parts += [
            block((i * (x - slim / 2), j * (y - slim / 2), height / 2.0), (slim, slim, height)) for i, j in _SIGNS
        ]
    if rng.random() < 0.55:
        parts.append(box((-x + 0.002, y - 0.008, 0.0), (x - 0.002, y, height)))
    for low, high in zip(levels[:-1].tolist(), levels[1:].tolist(), strict=True):
        if rng.random() < 0.3 and width > 0.6:
            at = rng.uniform(-0.3, 0.3) * width
            parts.append(box((at - thick / 2.0, -y + 0.002, low), (at + thick / 2.0, y - 0.002, high + 0.002)))
    return together(*parts)


def cabinet(rng: np.random.Generator) -> Mesh:
    """A chest of drawers, a cupboard or a sideboard, on feet or a plinth."""
    width, depth, height = rng.uniform(0.4, 1.5), rng.uniform(0.32, 0.55), rng.uniform(0.5, 1.3)
    foot, x, y = rng.uniform(0.03, 0.18), width / 2.0, depth / 2.0
    parts = [box((-x, -y, foot), (x, y, height)), block((0.0, 0.0, height + 0.008), (width + 0.03, depth + 0.02, 0.02))]
    if foot < 0.08:
        parts.append(box((-x + 0.02, -y + 0.04, 0.0), (x - 0.02, y - 0.02, foot + 0.002)))
    else:
        taper = rng.uniform(0.012, 0.02)
        parts += [
            rod((i * (x - 0.05), j * (y - 0.05), 0.0), (i * (x - 0.05), j * (y - 0.05), foot + 0.002), taper, 0.025)
            for i, j in _SIGNS
        ]
    columns = max(1, round(width / rng.uniform(0.38, 0.6)))
    wide = width / columns
    for column in range(columns):
        middle = -x + (column + 0.5) * wide
        rows = int(rng.integers(1, 5))
        step = (height - foot) / rows
        for row in range(rows):
            low, high = foot + row * step + 0.006, foot + (row + 1) * step - 0.006
            parts += _front(rng, (middle, wide - 0.012), (low, high), -y)
    return together(*parts)


def _front(rng: np.random.Generator, across: tuple[float, float], heights: tuple[float, float], y: float) -> list[Mesh]:
    """A drawer's or a door's front with its handle. across: middle and width."""
    (middle, wide), (low, high) = across, heights
    out = rng.uniform(0.01, 0.022)
    parts = [box((middle - wide / 2.0, y - out, low), (middle + wide / 2.0, y + 0.01, high))]
    at = (low + high) / 2.0 if high - low < 0.35 else low + 0.7 * (high - low)
    if rng.random() < 0.5:
        parts.append(ball((middle, y - out - 0.012, at), 0.016, 10))
    else:
        half = min(0.3 * wide, 0.08)
        parts.append(rod((middle - half, y - out - 0.02, at), (middle + half, y - out - 0.02, at), 0.006, sides=8))
        parts += [
            rod(
                (middle + s * 0.8 * half, y - out - 0.02, at),
                (middle + s * 0.8 * half, y - out + 0.005, at),
                0.005,
                sides=8,
            )
            for s in (-1, 1)
        ]
    return parts


def _drawers(
    rng: np.random.Generator, size: tuple[float, float], heights: tuple[float, float], count: int
) -> list[Mesh]:
    """A body with ``count`` drawers, its front at -y."""
    (wide, deep), (low, high) = size, heights
    parts = [box((-wide / 2.0, -deep / 2.0, low), (wide / 2.0, deep / 2.0, high))]
    step = (high - low) / count
    for row in range(count):
        parts += _front(
            rng, (0.0, wide - 0.01), (low + row * step + 0.005, low + (row + 1) * step - 0.005), -deep / 2.0
        )
    return parts


def _supports(rng: np.random.Generator, style: str, half: tuple[float, float], height: float) -> list[Mesh]:
    x, y = half
    if style == "pedestal":
        return _pedestal(rng, min(x, y), height)
    if style == "trestle":
        foot = rng.uniform(0.03, 0.05)
        parts = [block((s * 0.75 * x, 0.0, foot / 2.0), (0.06, 1.7 * y, foot)) for s in (-1, 1)]
        parts += [beam((s * 0.75 * x, 0.0, foot / 2.0), (s * 0.75 * x, 0.0, height), 0.07, 0.05) for s in (-1, 1)]
        parts += [block((s * 0.75 * x, 0.0, height - 0.02), (0.05, 1.6 * y, 0.04)) for s in (-1, 1)]
        return [*parts, beam((-0.75 * x, 0.0, 0.35 * height), (0.75 * x, 0.0, 0.35 * height), 0.03, 0.07)]
    if style == "panels":
        return [block((s * x, 0.0, height / 2.0), (rng.uniform(0.018, 0.04), 2.0 * y, height)) for s in (-1, 1)]
    thick = rng.uniform(0.03, 0.07)
    if style == "square":
        return [block((i * x, j * y, height / 2.0), (thick, thick, height)) for i, j in _SIGNS]
    if style == "splayed":
        out = rng.uniform(1.02, 1.2)
        return [
            rod((i * x * out, j * y * out, 0.0), (i * 0.85 * x, j * 0.85 * y, height), thick / 4, thick / 2)
            for i, j in _SIGNS
        ]
    profile = _turned_profile(rng, height, thick / 2.0)
    return [turned(profile, 16).shifted(i * x, j * y, 0.0) for i, j in _SIGNS]


def _pedestal(rng: np.random.Generator, reach: float, height: float) -> list[Mesh]:
    column = turned(_turned_profile(rng, height, rng.uniform(0.025, 0.06)), 20)
    foot, spread = rng.uniform(0.015, 0.035), rng.uniform(0.55, 0.85) * reach
    if rng.random() < 0.5:
        return [column, disc((0.0, 0.0, 0.0), (spread, spread), foot)]
    count = int(rng.integers(3, 6))
    parts = [column]
    for k in range(count):
        angle = 2.0 * math.pi * k / count
        tip = (1.15 * spread * math.cos(angle), 1.15 * spread * math.sin(angle))
        parts.append(beam((0.0, 0.0, rng.uniform(0.1, 0.2)), (*tip, foot), 0.05, 0.04))
        parts.append(rod((*tip, 0.0), (*tip, foot + 0.02), 0.025))
    return parts


def _turned_profile(rng: np.random.Generator, height: float, radius: float) -> list[tuple[float, float]]:
    """A leg as a lathe makes it: swellings and necks."""
    levels = np.linspace(0.0, height, int(rng.integers(4, 10)))
    swell = rng.uniform(0.6, 1.5, len(levels)) * radius
    return [(0.0, 0.0), *zip(swell.tolist(), levels.tolist(), strict=True), (0.0, height)]


def _skirt(rng: np.random.Generator, half: tuple[float, float], under: float) -> list[Mesh]:
    """Boards between the legs under the top; ornate ones vary in depth along their length."""
    x, y = half
    deep, thick = rng.uniform(0.04, 0.13), 0.018
    waves = int(rng.integers(1, 5)) if rng.random() < 0.5 else 0
    parts = []
    for start, end in (((-x, -y), (x, -y)), ((x, -y), (x, y)), ((x, y), (-x, y)), ((-x, y), (-x, -y))):
        count = 24 if waves else 1
        shares = np.linspace(0.0, 1.0, count + 1)
        for a, b in zip(shares[:-1].tolist(), shares[1:].tolist(), strict=True):
            low = deep * (0.65 + 0.35 * math.cos(2.0 * math.pi * waves * (a + b) / 2.0)) if waves else deep
            first, last = (np.array(start) + share * (np.array(end) - np.array(start)) for share in (a, b))
            corners = np.stack([first, last])
            lower, upper = corners.min(axis=0) - thick / 2.0, corners.max(axis=0) + thick / 2.0
            parts.append(box((*lower, under - low), (*upper, under)))
    return parts
