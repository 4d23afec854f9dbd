"""Tables of answers, for people."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from benchmarks.bop.answers import RIGHT, Answer, Recall

_BANDS: tuple[tuple[str, Callable[[float], bool]], ...] = (
    ("50 % and more", lambda share: share >= 0.5),
    ("20 to 50 %", lambda share: 0.2 <= share < 0.5),
    ("less than 20 %", lambda share: share < 0.2),
    ("not known", lambda share: bool(np.isnan(share))),
)

_LISTED = (
    *("scene", "image", "object", "visible", "verdict", "reason", "probability", "surface"),
    *("explained (by the truth)", "MSSD", "MSPD, px", "s"),
)


def summary(answers: Sequence[Answer], all_poses: Recall, accepted: Recall) -> str:
    """Recalls, verdicts by visible share, and time."""
    lines = [
        f"{all_poses.targets} targets, {len(answers)} detections. AR of MSSD {all_poses.mssd:.3f}, of MSPD"
        f" {all_poses.mspd:.3f}; of accepted poses alone {accepted.mssd:.3f}, {accepted.mspd:.3f}.",
        "",
        f"Right: no point of the placed surface is farther than {100 * RIGHT:.0f} % of the diameter from the true one."
        " One surface: all poses that an ambiguous answer lists place the same one, within as much.",
        "",
        "| visible | detections | right | right and registered | right and ambiguous: one surface | several surfaces |"
        " right and rejected | wrong and registered | no pose |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    bands = [(name, [one for one in answers if within(one.visible)]) for name, within in _BANDS]
    for name, some in [*bands, ("all", list(answers))]:
        if some:
            lines.append(f"| {name} | {len(some)} | {' | '.join(str(count) for count in _counts(some))} |")
    accepted_ones = [one for one in answers if one.verdict == "registered"]
    wrong = sum(not one.right for one in accepted_ones)
    times = [sum(one.seconds for one in each) for each in _by_image(answers)]
    lines += [
        "",
        f"Wrong among registered: {wrong} of {len(accepted_ones)}."
        f" Seconds a detection: median {_median(one.seconds for one in answers):.2f};"
        f" an image: median {_median(times):.2f}, mean {np.mean(times or [0.0]):.2f}.",
    ]
    return "\n".join(lines) + "\n"


def listing(answers: Sequence[Answer], others: Sequence[tuple[str, Sequence[Answer]]] = ()) -> str:
    """A row a detection; beside it ``surface`` and ``explained`` of other methods for the same object and image."""
    heads = [*_LISTED, *(name for name, _ in others)]
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    for one in answers:
        cells = [
            str(one.scene_id),
            str(one.im_id),
            str(one.obj_id),
            _share(one.visible),
            one.verdict,
            one.reason.split(":")[0],
            f"{one.probability:.3f}",
            _percent(one.surface) + (f" ({_percent(one.listed)})" if one.listed < one.surface else ""),
            f"{_share(one.explained)} ({_share(one.truth_explains)})",
            _percent(one.mssd),
            "" if np.isinf(one.mspd) else f"{one.mspd:.1f}",
            f"{one.seconds:.2f}",
        ]
        for _, theirs in others:
            same = [each for each in theirs if _place(each) == _place(one) and each.number in (one.number, None)]
            best = min(same, key=lambda each: each.surface, default=None)
            cells.append("none" if best is None else f"{_percent(best.surface)}, {_share(best.explained)}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _counts(answers: Sequence[Answer]) -> tuple[int, ...]:
    right = [one for one in answers if one.right]
    ambiguous = [one for one in right if one.verdict == "ambiguous"]
    same = sum(one.spread <= RIGHT for one in ambiguous)
    return (
        len(right),
        sum(one.verdict == "registered" for one in right),
        same,
        len(ambiguous) - same,
        sum(one.verdict == "rejected" for one in right),
        sum(one.verdict == "registered" and not one.right for one in answers),
        sum(one.pose is None for one in answers),
    )


def _by_image(answers: Iterable[Answer]) -> list[list[Answer]]:
    found: dict[tuple[int, int], list[Answer]] = {}
    for one in answers:
        found.setdefault((one.scene_id, one.im_id), []).append(one)
    return list(found.values())


def _place(answer: Answer) -> tuple[int, int, int]:
    return answer.scene_id, answer.im_id, answer.obj_id


def _median(values: Iterable[float]) -> float:
    known = list(values)
    return float(np.median(known)) if known else 0.0


def _percent(share: float) -> str:
    return "none" if np.isinf(share) else f"{100 * share:.1f} %"


def _share(share: float) -> str:
    return "" if np.isnan(share) else f"{100 * share:.0f} %"
