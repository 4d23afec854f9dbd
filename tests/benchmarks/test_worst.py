"""Pictures of what went most wrong."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.worlds.worst import View, worst_of


def run(probability: float, off: float, listed: float | None = None) -> dict[str, Any]:
    return {
        "mssd_share": off,
        "listed_mssd": off if listed is None else listed,
        "metrics": {"probability": probability},
    }


def test_the_worst_are_those_the_engine_was_surest_of() -> None:
    failed: dict[str, Any] = {"verdict": "none"}
    surest, less, right, listed = run(0.9, 0.4), run(0.6, 1.2), run(0.99, 0.01), run(0.98, 0.5, listed=0.02)
    assert worst_of([less, right, failed, listed, surest], 5) == [surest, less]
    assert worst_of([less, surest], 1) == [surest]


def test_of_evidence_the_answers_about_right_objects_count() -> None:
    row = {"question": "right", "winner": True, "found": True, "probability": 0.9, "mssd": 0.4, "listed_mssd": 0.4}
    others = [row | {"question": "other"}, row | {"winner": False}, row | {"mssd": 0.01, "listed_mssd": 0.01}]
    (worst,) = worst_of([*others, row], 5)
    assert worst["metrics"]["probability"] == 0.9
    assert worst["mssd_share"] == 0.4


def test_what_is_nearer_hides_what_is_behind() -> None:
    x, z = np.meshgrid(np.linspace(-1.0, 1.0, 200), np.linspace(-1.0, 1.0, 200))
    wall = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    normals = np.tile([0.0, -1.0, 0.0], (len(wall), 1))
    view = View.of(wall, normals)
    for y, hidden in ((-0.4, False), (0.4, True)):
        image = np.asarray(view.panel(wall, normals, np.array([[0.0, y, 0.0]]), (200, 0, 0))).astype(int)
        assert bool((image[..., 0] > image[..., 1] + 50).any()) is not hidden
