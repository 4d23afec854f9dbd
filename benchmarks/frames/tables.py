"""What rows of registrations in simulated frames show, as Markdown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.robust.judging import SUCCESS

Row = dict[str, Any]
ACCEPTED = ("registered", "ambiguous")
_BINS = ((0.5, 1.01), (0.2, 0.5), (0.1, 0.2))
_EDGES = (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.98, 1.01)


def success(row: Row) -> bool:
    """Accepted, and a pose that is listed is right."""
    return row["verdict"] in ACCEPTED and row["listed_error"] <= SUCCESS


def wrong(row: Row) -> bool:
    """Accepted, and no pose that is listed is right."""
    return row["verdict"] in ACCEPTED and not row["listed_error"] <= SUCCESS


def markdown(rows: Sequence[Row]) -> str:
    right = [row for row in rows if row["asked"] == "right"]
    lines = [
        "| views | visible | frames | best pose right | right and accepted | of these registered | accepted and wrong |"
        " of accepted |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for views, name in ((lambda n: n == 1, "1"), (lambda n: n > 1, "2 to 5")):
        for low, high in _BINS:
            some = [row for row in right if views(row["views"]) and low <= row["visible"] < high]
            lines.append(f"| {name} | {100 * low:.0f} to {min(100 * high, 100):.0f} % | {_counted(some)} |")
    lines += ["", "| asked for | questions | registered | ambiguous |", "|---|---|---|---|"]
    for asked in dict.fromkeys(row["asked"] for row in rows if row["asked"] != "right"):
        some = [row for row in rows if row["asked"] == asked]
        bad = [Counter(row["verdict"] for row in some if wrong(row))[verdict] for verdict in ACCEPTED]
        lines.append(f"| {asked} | {len(some)} | {bad[0]} | {bad[1]} |")
    accepted = [row for row in rows if row["verdict"] in ACCEPTED]
    registered = [row for row in accepted if row["verdict"] == "registered"]
    single = [row for row in rows if row["views"] == 1]
    bad, worse = sum(map(wrong, accepted)), sum(map(wrong, registered))
    lines += [
        "",
        f"Of all {len(accepted)} accepted answers {bad} are wrong ({_share(bad, len(accepted))}),"
        f" of {len(registered)} registered {worse} ({_share(worse, len(registered))}).",
        f"Expected calibration error: {calibration(rows):.3f}; of the right questions {calibration(right):.3f};"
        f" of single views {calibration(single):.3f}.",
    ]
    groups = {
        "sensor": lambda row: row["sensor"],
        "size": lambda row: "furniture" if row["furniture"] else "small things",
        "detection": lambda row: row["detection"].split()[0],
    }
    lines += ["", "| by | frames | best pose right | right and accepted | of these registered | wrong | of accepted |"]
    lines += ["|---|---|---|---|---|---|---|", *(grouped(right, by) for by in groups.values())]
    return "\n".join([*lines, "", *_reliability([row for row in rows if row["asked"] != "altered"])]) + "\n"


def _reliability(rows: Sequence[Row]) -> list[str]:
    lines = ["| probability said, without altered objects | answers | mean said | right |", "|---|---|---|---|"]
    told = [(row["probability"], row["listed_error"] <= SUCCESS) for row in rows if "probability" in row]
    for low, high in pairwise(_EDGES):
        said = np.array([one for one in told if low <= one[0] < high], dtype=np.float64).reshape(-1, 2)
        mean, held = said.mean(0) if len(said) else (float("nan"), float("nan"))
        lines.append(f"| {low:g} to {min(high, 1.0):g} | {len(said)} | {mean:.3f} | {held:.3f} |")
    return lines


def _counted(rows: Sequence[Row]) -> str:
    good, bad = sum(map(success, rows)), sum(map(wrong, rows))
    registered = sum(success(row) and row["verdict"] == "registered" for row in rows)
    found = sum(row.get("error", 9.0) <= SUCCESS for row in rows)
    parts = (f"{one} ({_share(one, len(rows))})" for one in (found, good))
    return " | ".join([str(len(rows)), *parts, str(registered), str(bad), _share(bad, good + bad)])


def _share(part: int, whole: int) -> str:
    return f"{100.0 * part / max(whole, 1):.1f} %"


def calibration(rows: Iterable[Row], bins: int = 10) -> float:
    """Expected calibration error of the answers: that one of the listed poses is right."""
    told = [(row["probability"], row["listed_error"] <= SUCCESS) for row in rows if "probability" in row]
    if not told:
        return float("nan")
    said, held = np.array(told, dtype=np.float64).T
    of = np.minimum((said * bins).astype(int), bins - 1)
    gaps = [abs(said[of == k].sum() - held[of == k].sum()) for k in range(bins)]
    return float(sum(gaps) / len(told))


def grouped(rows: Sequence[Row], by: Callable[[Row], Any]) -> str:
    """The counts of the right questions by a fact."""
    right = [row for row in rows if row["asked"] == "right"]
    keys = sorted({by(row) for row in right}, key=str)
    return "\n".join(f"| {key} | {_counted([row for row in right if by(row) == key])} |" for key in keys)
