"""Where the first two candidates of a search differ, and what the scene says there: one panel of a result's picture.

Dots are surface that only the first candidate has, rings are surface that only the second has, each where it stands in
the scene. Their colors tell what the scene says. What the first candidate's surface hides is drawn half as strong.
Torch-free: the front end draws it too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from regnf_core.document import ABSENT, SHOWN, UNKNOWN
from regnf_core.viewing.splats import Floats, Surfels, View, nearest_surfels, paint

DIFFERENCE = "difference.ply"
"""The file of a search's deciding surface. Properties beside those of other clouds: `candidate`, 1 the first and 2 the
second, whose surface it is; `state`, as in :class:`regnf_core.document.DecidingSurface`."""
STATE_COLORS = np.array([(0.00, 0.45, 0.30), (0.84, 0.15, 0.12), (0.47, 0.44, 0.62)])
"""Of SHOWN, ABSENT and UNKNOWN: green, red, gray violet."""
FILL = 0.7
"""Share of the panel that the surfaces may fill: the legend stands below them."""
_RAISED = 0.06  # share of the panel
_SAID = {SHOWN: "observed in the scene", ABSENT: "free space in the scene", UNKNOWN: "unobserved or unclear"}
_DRAWN = ("only the first has it", "only the second has it", "the first (faint: hidden)")
_BODY_COLOR = (0.93, 0.935, 0.94)
_SWATCH = (0.76, 0.77, 0.78)  # as the body looks in the shade
_DOT = 0.012  # of the panel's edge: radius of a dot
_HOLE = 0.55  # of the radius: that of a ring's hole
_HIDDEN = 0.5  # strength of what is hidden
_INK = (52, 56, 62)
_LINE = 19


@dataclass(frozen=True)
class Deciding:
    """A :class:`regnf_core.document.DecidingSurface` as arrays: points (N, 3), of_other (N,) bool, states (N,)."""

    points: Floats
    of_other: NDArray[np.bool_]
    states: NDArray[np.uint8]
    distinguishable: bool

    def share(self, state: int) -> float:
        return float((self.states == state).mean()) if len(self.states) else 0.0

    def conclusion(self) -> str:
        """For which candidate it speaks, as a sentence: for the one whose surface is there, or the other's is not."""
        seen = self.states != UNKNOWN
        if not self.distinguishable or not seen.any():
            return "Too little of the difference was observed to distinguish the two."
        for_first = float(((self.states == SHOWN) != self.of_other)[seen].mean())
        return f"{100 * for_first:.0f} % of the observed difference supports the first."


def difference_panel(
    body: Surfels, radius: float, deciding: Deciding, view: View, edge: int, background: Floats
) -> Image.Image:
    """A square picture of half the view's edge. body: the first candidate over the scene, drawn in gray · radius: of
    its discs, scene units."""
    view = replace(view, center=view.center - _RAISED * edge / view.pixels_per_unit * view.axes[1])
    gray = replace(body, colors=np.broadcast_to(np.array(_BODY_COLOR), body.points.shape))
    in_front = nearest_surfels(gray, view, edge, radius)
    picture = paint(gray, in_front, view, background).astype(np.float64)
    if len(deciding.points):
        size = _DOT * edge / view.pixels_per_unit
        towards = np.broadcast_to(view.axes[2], deciding.points.shape)  # flat on the picture: none is seen edge-on
        dots = Surfels(deciding.points, towards, STATE_COLORS[deciding.states])
        found, hole = (nearest_surfels(dots, view, edge, share * size) for share in (1.0, _HOLE))
        drawn = (found >= 0) & ~(deciding.of_other[found] & (hole == found))
        depth = dots.points @ view.axes[2]
        behind = (in_front >= 0) & ((gray.points @ view.axes[2])[in_front] > depth[found] + radius)
        strength = (drawn * np.where(behind, _HIDDEN, 1.0))[..., None]
        picture = (1.0 - strength) * picture + strength * 255.0 * dots.colors[found]
    halved = picture.reshape(edge // 2, 2, edge // 2, 2, 3).mean((1, 3))
    panel = Image.fromarray(halved.round().astype(np.uint8))
    _write_legend(panel, deciding)
    return panel


def _write_legend(panel: Image.Image, deciding: Deciding) -> None:
    """Three rows of two columns: what the colors say, and what is drawn."""
    draw, small = ImageDraw.Draw(panel), ImageFont.load_default(size=14)
    top = panel.height - _LINE * len(_SAID) - 10
    colors = [tuple((255 * np.array(color)).astype(int).tolist()) for color in (*STATE_COLORS, _SWATCH)]
    for row, (state, words) in enumerate(_SAID.items()):
        y = top + row * _LINE
        draw.rectangle((24, y + 4, 34, y + 14), fill=colors[state])
        draw.text((42, y), f"{words}: {100 * deciding.share(state):.0f} %", fill=_INK, font=small)
        draw.text((294, y), _DRAWN[row], fill=_INK, font=small)
    box = (275, top + 4, 285, top + 14)
    draw.ellipse(box, fill=_INK)
    draw.ellipse([side + down for side, down in zip(box, (0, _LINE, 0, _LINE), strict=True)], outline=_INK, width=2)
    draw.rectangle([side + down for side, down in zip(box, (0, 2 * _LINE, 0, 2 * _LINE), strict=True)], fill=colors[-1])
