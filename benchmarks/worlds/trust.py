"""How far answers can be trusted: of those that are accepted, how many are wrong, for each kind of data.

    python -m benchmarks.worlds trust rows.jsonl.gz ... [--output table.md] [--diagrams FOLDER]

Rows are those of ``evidence``: what was asked, the probability that the engine told, and how far off the answer is. An
answer is right if one of the poses that it lists is. What could not be told from the right object by what was seen is
counted by itself.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from benchmarks.robust.judging import SUCCESS
from benchmarks.worlds.tables import lower_bound, upper_bound
from regnf_core.robust.verdict.evaluation import LEVELS

Row = dict[str, Any]
Array = NDArray[np.float64]
LEAST_SEEN = 0.02
"""Share of both surfaces that differs and was seen, for an object to count as another one."""
_BINS = (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.98, 1.0)
_SCENES = {"tsdf": "noisy cameras", "rendered": "clean depth"}
_TOLD = {"images": "", "nothing": ", without observation", "recording": ", the recording as the scene"}


def is_right(row: Row) -> bool:
    """Whether one of the poses that the answer lists is right."""
    return bool(row["listed_mssd"] <= SUCCESS)


def cannot_be_told(row: Row) -> bool:
    """A wrong object that what was seen does not tell from the right one."""
    return not is_right(row) and row.get("question", "right") != "right" and row["seen_difference"] < LEAST_SEEN


def kind_of(row: Row) -> str:
    """The kind of data, in words."""
    if row["scene"] == "frames":
        return f"detections in images, {'one view' if row['length'] == 'single' else 'few views'}"
    return f"{_SCENES.get(row['scene'], row['scene'])}, {row['length']}{_TOLD.get(row['observed_by'], '')}"


def trust_table(rows: Sequence[Row]) -> str:
    """Markdown. rows: of :mod:`benchmarks.worlds.evidence`; of each registration the one of its answer counts, and
    seeds other than 0 only where seeds are compared."""
    every = [row for row in rows if row["winner"] and row["found"]]
    answers = [row for row in every if row.get("seed", 0) == 0]
    told = [row for row in answers if not cannot_be_told(row)]
    parts = [
        f"{len(answers)} registrations of {len({row['world'] for row in answers})} worlds{_revisions(answers)}.",
        _of_kinds(told, [row for row in told if row["question"] == "right"], "The right object is requested."),
        _of_kinds(told, told, "Right and wrong questions together."),
        _of_verdicts([row for row in told if row["question"] == "right"]),
        _of_questions(answers),
        _of_variants(answers),
        _of_seeds(every),
        _calibration(told),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _revisions(rows: Sequence[Row]) -> str:
    """Of the engine, where rows have them."""
    found = sorted({row["revision"] for row in rows if "revision" in row})
    return f", engine revision {', '.join(map(str, found))}" if found else ""


def _groups(rows: Sequence[Row], key: Callable[[Row], str]) -> Iterator[tuple[str, list[Row]]]:
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(key(row), []).append(row)
    yield from sorted(found.items())
    if len(found) > 1:
        yield "**all**", list(rows)


def _of_kinds(everything: Sequence[Row], asked: Sequence[Row], title: str) -> str:
    """asked: what acceptance is counted of · everything: what calibration is."""
    head = ["kind of data", "registrations", "correct pose"]
    head += [
        f"{name}: {what}" for name in LEVELS for what in ("correct and accepted", "wrong among accepted", "at most")
    ]
    head += ["calibration error", "AUROC"]
    lines = []
    every = dict(_groups(everything, kind_of))
    for kind, group in _groups(asked, kind_of):
        right = [row for row in group if is_right(row)]
        line = [kind, str(len(group)), _percent(len(right), len(group))]
        for least in LEVELS.values():
            taken = [row for row in group if _accepted(row, least)]
            wrong = sum(not is_right(row) for row in taken)
            line += [_percent(len(taken) - wrong, len(group)), f"{wrong} of {len(taken)}"]
            line.append(f"{100 * upper_bound(wrong, len(taken)):.1f} %" if taken else "")
        p, hit = _said(every[kind]), np.array([is_right(row) for row in every[kind]])
        lines.append([*line, f"{calibration_error(p, hit):.3f}", f"{auroc(p, hit):.4f}"])
    return f"{title}\n\n{_cells(head, lines)}"


def _of_verdicts(asked: Sequence[Row]) -> str:
    """asked: answers about right objects."""
    parts = []
    for verdict, what in (("registered", "are wrong"), ("ambiguous", "list no correct pose")):
        found = [row for row in asked if row.get("verdict") == verdict]
        wrong = sum(not is_right(row) for row in found)
        if found:
            bound = f"at most {100 * upper_bound(wrong, len(found)):.1f} %"
            parts.append(f"Of {len(found)} answers `{verdict}`, {wrong} {what} ({bound}).")
    return " ".join(["The right object is requested, default level.", *parts]) if parts else ""


def _of_questions(answers: Sequence[Row]) -> str:
    head = ["question", "registrations", "correct pose", *(f"wrong and accepted, {name}" for name in LEVELS)]
    head.append("not distinguishable: accepted")
    lines = []
    for question, group in _groups(answers, lambda row: str(row["question"])):
        told = [row for row in group if not cannot_be_told(row)]
        rest = [row for row in group if cannot_be_told(row)]
        wrong = [row for row in told if not is_right(row)]
        line = [question, str(len(group)), str(len(told) - len(wrong))]
        line += [f"{sum(_accepted(row, least) for row in wrong)} of {len(wrong)}" for least in LEVELS.values()]
        lines.append([*line, f"{sum(_accepted(row, LEVELS['default']) for row in rest)} of {len(rest)}"])
    return f"By what is requested.\n\n{_cells(head, lines)}"


def _of_variants(answers: Sequence[Row]) -> str:
    """Of variants that were compared with the right object at a right pose: by what tells them apart."""
    compared = [row for row in answers if row.get("difference") and not is_right(row)]
    if not compared:
        return ""
    seen = [row for row in compared if row["difference"]["distinguishable"]]
    first = sum(row["difference"]["favor"] > 0.0 for row in seen)
    unseen = [row for row in compared if row["seen_difference"] < LEAST_SEEN / 2.0]
    said = sum(not row["difference"]["distinguishable"] for row in unseen)
    return (
        f"Variants beside the right object as candidates: {len(compared)}. Reported as distinguishable: {len(seen)}; "
        f"of these, the evidence favors the right one in {_percent(first, len(seen))}. The difference was not seen in "
        f"{len(unseen)}; of these, reported as not distinguishable: {_percent(said, len(unseen))}."
    )


def _of_seeds(answers: Sequence[Row]) -> str:
    """Of questions that were asked with several seeds of the registration: how often two seeds have one verdict."""
    asked: dict[tuple[Any, ...], list[Row]] = {}
    for row in answers:
        key = tuple(row.get(name) for name in ("world", "case", "question", "observed_by"))
        asked.setdefault(key, []).append(row)
    pairs = [
        (one, other)
        for rows in asked.values()
        for one, other in itertools.combinations(rows, 2)
        if one.get("seed") != other.get("seed")
    ]
    if not pairs:
        return ""
    same = sum(one["verdict"] == other["verdict"] for one, other in pairs)
    alike = sum(_accepted(one, LEVELS["default"]) == _accepted(other, LEVELS["default"]) for one, other in pairs)
    return (
        f"Two seeds of a registration have the same verdict in {_percent(same, len(pairs))} of the pairs, and both or "
        f"neither are accepted in {_percent(alike, len(pairs))}."
    )


def _calibration(told: Sequence[Row]) -> str:
    p, right = _said(told), np.array([is_right(row) for row in told])
    lines = [
        [f"{low:g} to {high:g}", str(int(within.sum())), f"{p[within].mean():.3f}", f"{right[within].mean():.3f}"]
        for within, low, high in binned(p)
        if within.any()
    ]
    return "Calibration.\n\n" + _cells(["probability", "answers", "mean", "correct"], lines)


def _accepted(row: Row, least: float) -> bool:
    return bool(row["probability"] >= least)


def _said(rows: Sequence[Row]) -> Array:
    return np.array([row["probability"] for row in rows], dtype=np.float64)


def auroc(scores: Array, right: NDArray[np.bool_]) -> float:
    """How often a right answer has the higher score, of all pairs of a right and a wrong one; ties count half."""
    positive, negative = int(right.sum()), int((~right).sum())
    if positive == 0 or negative == 0:
        return float("nan")
    return float((rankdata(scores)[right].sum() - positive * (positive + 1) / 2) / (positive * negative))


def calibration_error(probability: Array, right: NDArray[np.bool_]) -> float:
    """Mean difference between what was told and what was right over the bins, weighted by their answers."""
    return sum(
        float(within.mean() * abs(probability[within].mean() - right[within].mean()))
        for within, _, _ in binned(probability)
        if within.any()
    )


def binned(probability: Array) -> list[tuple[NDArray[np.bool_], float, float]]:
    """Which answers lie in each bin, and its ends."""
    return [
        ((probability >= low) & ((probability < high) | (high == 1.0)), low, high)
        for low, high in itertools.pairwise(_BINS)
    ]


def _percent(hits: int, total: int) -> str:
    return f"{hits} of {total} ({100 * hits / total:.1f} %)" if total else "0 of 0"


def _cells(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


# The reliability diagram: how often answers were right, over what was told.

_SIZE, _MARGIN = 420, 50
"""Pixels: edge of the square of both axes from 0 to 1, and what is left around it for their names."""
_TICKS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
_STYLE = (
    "text{font:13px sans-serif;fill:#333}.frame{fill:#fff;stroke:#333}.ideal{stroke:#999;stroke-dasharray:5 4}"
    ".bounds{stroke:#1f5fa8;stroke-width:2}.point{fill:#1f5fa8}"
)


def reliability_diagrams(rows: Sequence[Row]) -> dict[str, str]:
    """One SVG a kind of data."""
    told = [row for row in rows if row["winner"] and row["found"] and not cannot_be_told(row)]
    return {kind: reliability_diagram(kind, group) for kind, group in _groups(told, kind_of)}


def reliability_diagram(title: str, answers: Sequence[Row]) -> str:
    """SVG. One point for each bin of the table, at the mean of what was told and the share of the answers that were
    right, with exact one-sided 95 % bounds of this share."""
    probability, right = _said(answers), np.array([is_right(row) for row in answers])
    points = [
        part
        for within, _, _ in binned(probability)
        if within.any()
        for part in _point(float(probability[within].mean()), int(right[within].sum()), int(within.sum()))
    ]
    edge, middle = _SIZE + 2 * _MARGIN, _MARGIN + _SIZE / 2
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {edge} {edge}" role="img">',
            f"<title>{title}: share of {len(right)} answers that are correct, over their probability</title>",
            f"<style>{_STYLE}</style>",
            f'<rect width="{edge}" height="{edge}" fill="#fff"/>',
            f'<text x="{middle}" y="{_MARGIN - 18}" text-anchor="middle">{title.strip("*")}: {len(right)}</text>',
            f'<rect class="frame" x="{_MARGIN}" y="{_MARGIN}" width="{_SIZE}" height="{_SIZE}"/>',
            f'<line class="ideal" x1="{_x(0)}" y1="{_y(0)}" x2="{_x(1)}" y2="{_y(1)}"/>',
            *(f'<text x="{_x(tick)}" y="{_y(0) + 18}" text-anchor="middle">{tick}</text>' for tick in _TICKS),
            *(f'<text x="{_x(0) - 8}" y="{_y(tick) + 4}" text-anchor="end">{tick}</text>' for tick in _TICKS),
            f'<text x="{middle}" y="{_y(0) + 38}" text-anchor="middle">mean probability</text>',
            f'<text transform="translate(14 {middle}) rotate(-90)" text-anchor="middle">share that is correct</text>',
            *points,
            "</svg>\n",
        ]
    )


def _point(said: float, right: int, count: int) -> Iterator[str]:
    low, high = lower_bound(right, count), upper_bound(right, count)
    x = _x(said)
    yield f'<line class="bounds" x1="{x}" y1="{_y(low)}" x2="{x}" y2="{_y(high)}"/>'
    yield f'<circle class="point" cx="{x}" cy="{_y(right / count)}" r="4"/>'


def _x(share: float) -> float:
    return round(_MARGIN + _SIZE * share, 1)


def _y(share: float) -> float:
    return round(_MARGIN + _SIZE * (1.0 - share), 1)
