"""A result document in words: verdict, transform, uncertainty and metrics."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, ProgressColumn, TaskProgressColumn, TimeElapsedColumn
from rich.table import Table

from regnf_core.document import level_in_words
from regnf_core.errors import Candidate, RegnfError, Said, hint_of

# What the commands share for talking to people and to programs.

EXIT_REGISTERED = 0
EXIT_NOT_REGISTERED = 1
EXIT_BAD_INPUT = 2
EXIT_UNAVAILABLE = 3
EXIT_AMBIGUOUS = 4

out = Console(highlight=False)
err = Console(stderr=True, highlight=False)
_PAGE = re.compile(r"\bdocs/([a-z0-9/-]+)\.md\b")


def fail(reason: str, message: str, code: int = EXIT_BAD_INPUT, hint: str | None = None) -> int:
    """Say on stderr what went wrong, and what to do next; returns the exit code."""
    err.print(f"[bold red]{reason}[/] ", end="")
    tell(_with_commands(message))
    if hint := hint or hint_of(reason):
        err.print("[bold]hint:[/] ", end="")
        tell(_with_commands(hint))
    return code


def show_candidates(error: RegnfError) -> None:
    """Say on stderr what to add to the command for each function that a refused file may be, if that is why."""
    asked: Sequence[Candidate] = getattr(error, "candidates", ())
    said: Said = getattr(error, "said", None) or Said(None, {})
    option = "--description" if said.use is None else f"--{said.use}-description"
    for number, one in enumerate(asked, 1):
        told = f"{number}  {one.name}\n   {option} {shlex.quote(json.dumps(one.added_to(said.description)))}"
        tell(told)


def _with_commands(text: str) -> str:
    """Pages of the manual by the command that prints them: an installed regnf has no folder docs."""
    return _PAGE.sub(r"`regnf manual \1`", text)


def say(text: str) -> None:
    """A line on stdout, as it is."""
    out.print(text, markup=False, soft_wrap=True)


def tell(text: str) -> None:
    """The same on stderr, for people: what is on stdout may be JSON."""
    err.print(text, markup=False, soft_wrap=True)


def warn(warnings: Iterable[str]) -> None:
    """Tell them, a line each."""
    for warning in warnings:
        tell(f"warning: {warning}")


@contextmanager
def reporting(phase: str) -> Iterator[Callable[[str, float], None]]:
    """A bar of phases and their shares, which begins with ``phase``."""
    with progress() as bar:
        task = bar.add_task(phase, total=1.0)
        yield lambda phase, share: bar.update(task, description=phase, completed=share)


def progress(*columns: str | ProgressColumn) -> Progress:
    """A bar on stderr, so that stdout stays clean for results. columns: in place of the share and the time."""
    rest = columns or (TaskProgressColumn(), TimeElapsedColumn())
    return Progress("{task.description:>14}", BarColumn(), *rest, console=err)


_EXIT_CODES = {"registered": EXIT_REGISTERED, "ambiguous": EXIT_AMBIGUOUS}
_COLORS = {"registered": "green", "ambiguous": "yellow"}


def exit_code(document: dict[str, Any]) -> int:
    """0 for a registered result, 4 for an ambiguous one, 1 for a rejected one."""
    return _EXIT_CODES.get(document["verdict"], EXIT_NOT_REGISTERED)


def show(document: dict[str, Any], as_json: bool, top: int = 0) -> None:
    """Print a result document as JSON, or in words, after the ``top`` most probable candidates of a search."""
    if as_json:
        out.print_json(json.dumps(document))
        return
    if top:
        show_ranking(document, top)
    show_result(document)


def show_result(document: dict[str, Any]) -> None:
    """Print what a result document says. Documents of other versions may lack everything but verdict and pose."""
    verdict = escape(document["verdict"])
    out.print(
        f"verdict      [bold {_COLORS.get(verdict, 'red')}]{verdict}[/]  ({escape(document['verdict_reason'])})",
        soft_wrap=True,
    )
    if detail := document.get("verdict_detail"):
        _line("", detail)
    meant = "one of the listed poses" if verdict == "ambiguous" else "the pose"
    if sure := in_percent(document, f" that {meant} is right"):
        _line("probability", sure)
    if hint := document.get("verdict_hint"):
        _line("hint", hint)
    for name in ("scene", "object"):
        notes = (document.get("fields") or {}).get(name) or {}
        for warning in notes.get("warnings") or ():
            _line("warning", f"{name}: {warning}")
        for line in notes.get("assumed") or () if verdict == "rejected" else ():
            _line("assumed", f"{name}: {line}")
    show_pose(document)
    if symmetry := document.get("symmetry"):
        _line("symmetry", symmetry_in_words(symmetry))
    if alternatives := document.get("alternatives"):
        table = Table("", "score", "relation to the result", title="alternatives", title_justify="left", box=None)
        for number, other in enumerate(alternatives, 1):
            table.add_row(str(number), f"{other['score']:.4f}", escape(other["relation"]))
        out.print(table)
    for name, value in (document.get("metrics") or {}).items():
        _line(f"{name:<28}", f"{value:.6g}" if isinstance(value, float) else str(value))


def in_percent(told: dict[str, Any], meant: str = "") -> str:
    """Probability and level of a result or a candidate: `99.8 % (strict)`; "" where there is none."""
    if told.get("probability") is None:
        return ""
    level = f" ({level_in_words(told['level'])})" if "level" in told else ""
    return f"{100 * told['probability']:.1f} %{meant}{level}"


def show_pose(document: dict[str, Any]) -> None:
    """Print where the object stands in the scene, how large it is there, and how sure that is."""
    transform = document["T_scene_object"]
    out.print("T_scene_object, the object's pose in the scene:")
    for row in transform["matrix"]:
        out.print("   " + " ".join(f"{value: .6f}" for value in row))
    sigmas = document.get("uncertainty") or {}
    if (center := document.get("center_scene")) is not None:
        sure = f", ± {_numbers(sigmas['center_scene'])} scene units" if sigmas else ""
        _line("center", f"{' '.join(f'{value:.4f}' for value in center)} in the scene{sure}")
    if (camera := document.get("camera")) is not None:
        turn = camera["T_camera_object"]["rotation_quaternion_xyzw"]
        _line(
            "camera", f"center {' '.join(f'{value:.4f}' for value in camera['center_camera'])} m before the camera of"
        )
        _line("", f"frame {camera['frame']}; rotation {' '.join(f'{value:.4f}' for value in turn)} (x, y, z, w)")
    deviation = sigmas.get("scale_percent")
    give_or_take = "" if deviation is None else f", ± {deviation:.2g} %"
    _line("scale", f"{1.0 / transform['scale']:.6f} object units per scene unit{give_or_take}")
    if sigmas:
        _line("rotation", f"± {_numbers(sigmas['rotation_deg'])} degrees about the object's x, y, z")
        _line("", "± is one standard deviation")


def show_ranking(document: dict[str, Any], top: int) -> None:
    """Print the ``top`` most likely candidates of a search, and the files that are no objects."""
    table = Table("", "object", "score", "probability", "verdict", title="candidates", title_justify="left", box=None)
    ranked = [one for one in document["candidates"] if one["stage"] != "unusable"]
    for number, one in enumerate(ranked[:top], 1):
        score = "-" if one["score"] is None else f"{one['score']:.4f}"
        verdict = f"{one['verdict']} ({one['verdict_reason']})" if one["verdict"] else f"not refined ({one['stage']})"
        table.add_row(str(number), escape(one["object"]), score, in_percent(one), escape(verdict))
    out.print(table)
    for number, one in enumerate(ranked[:top], 1):
        if (found := one.get("difference")) is not None:
            _line("", f"{number} {difference_in_words(found)}")
    if len(ranked) > top:
        _line("", f"and {len(ranked) - top} more")
    for one in document["candidates"][len(ranked) :]:
        _line("", f"no object: {one['object']} ({one['verdict_reason']})")


def difference_in_words(difference: dict[str, Any]) -> str:
    """Text after the number of a search candidate: whether the observed surface distinguishes it from the first one."""
    if not difference["distinguishable"]:
        return "cannot be distinguished from the first by the observed surface"
    return f"is distinguished from the first by {100 * difference['seen']:.1f} % of the surface, which was observed"


def axis_in_words(axis: Sequence[float]) -> str:
    """z for (0, 0, 1) and its opposite, for a turn is about both; else the direction."""
    parts = [round(value, 2) + 0.0 for value in axis]  # adding zero makes -0.00 plain
    if sorted(map(abs, parts)) == [0, 0, 1]:
        return "xyz"[[abs(part) for part in parts].index(1)]
    return f"({', '.join(f'{part:.2f}' for part in parts)})"


def symmetry_in_words(symmetry: dict[str, Any]) -> str:
    """An object's symmetry as a result document has it: order, axis, continuous."""
    order, axis = symmetry["order"], symmetry["axis"]
    about = "" if axis is None else f" about {axis_in_words(axis)} of the object"
    if symmetry["continuous"]:
        return f"any rotation{about}" + (", and upside down" if order > 1 else "")
    return "none found" if order == 1 else f"{order} rotations{about} look the same, including the identity"


def _line(name: str, value: str) -> None:
    say(f"{name:<12} {value}")


def _numbers(values: list[float | None]) -> str:
    return " ".join("-" if value is None else f"{value:.2g}" for value in values)
