"""A picture of how well probabilities hold, the reliability diagram: how often poses were right, over what was said."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from benchmarks.robust.judging import SUCCESS
from benchmarks.worlds.calibration import Array, binned
from benchmarks.worlds.tables import lower_bound, upper_bound

_SIZE, _MARGIN = 420, 50
"""Pixels: edge of the square of both axes from 0 to 1, and what is left around it for their names."""
_TICKS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
_STYLE = (
    "text{font:13px sans-serif;fill:#333}.frame{fill:#fff;stroke:#333}.ideal{stroke:#999;stroke-dasharray:5 4}"
    ".bounds{stroke:#1f5fa8;stroke-width:2}.point{fill:#1f5fa8}"
)


def reliability_diagram(rows: Sequence[dict[str, Any]], logits: Array) -> str:
    """SVG. One point for each bin of the table, at the mean of what was said and the share of the poses that were
    right, with one-sided 95 % bounds of this share; rows and logits as
    :func:`benchmarks.worlds.calibration.calibration_table` has them."""
    chosen = np.array([row["winner"] for row in rows])
    probability = 1.0 / (1.0 + np.exp(-logits[chosen]))
    right = np.array([row["mssd"] for row in rows])[chosen] <= SUCCESS
    points = [
        part
        for within, _, _ in binned(probability)
        if within.any()
        for part in _point(float(probability[within].mean()), int(right[within].sum()), int(within.sum()))
    ]
    edge = _SIZE + 2 * _MARGIN
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {edge} {edge}" role="img">',
            f"<title>Share of {len(right)} poses that were right, over the probability that was said</title>",
            f"<style>{_STYLE}</style>",
            f'<rect width="{edge}" height="{edge}" fill="#fff"/>',
            f'<rect class="frame" x="{_MARGIN}" y="{_MARGIN}" width="{_SIZE}" height="{_SIZE}"/>',
            f'<line class="ideal" x1="{_x(0)}" y1="{_y(0)}" x2="{_x(1)}" y2="{_y(1)}"/>',
            *_axes(),
            *points,
            "</svg>\n",
        ]
    )


def _axes() -> Iterator[str]:
    for tick in _TICKS:
        yield f'<text x="{_x(tick)}" y="{_y(0) + 18}" text-anchor="middle">{tick}</text>'
        yield f'<text x="{_x(0) - 8}" y="{_y(tick) + 4}" text-anchor="end">{tick}</text>'
    middle = _MARGIN + _SIZE / 2
    yield f'<text x="{middle}" y="{_y(0) + 38}" text-anchor="middle">probability that was said, mean</text>'
    yield f'<text transform="translate(14 {middle}) rotate(-90)" text-anchor="middle">share that was right</text>'


def _point(said: float, right: int, count: int) -> Iterator[str]:
    low, high = lower_bound(right, count), upper_bound(right, count)
    x = _x(said)
    yield f'<line class="bounds" x1="{x}" y1="{_y(low)}" x2="{x}" y2="{_y(high)}"/>'
    yield f'<circle class="point" cx="{x}" cy="{_y(right / count)}" r="4"/>'


def _x(share: float) -> float:
    return round(_MARGIN + _SIZE * share, 1)


def _y(share: float) -> float:
    return round(_MARGIN + _SIZE * (1.0 - share), 1)
