"""``regnf batch``: many registrations from one file, here or on a server."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from regnf_cli.batch_file import FilePair, ResultsFile, read_pairs
from regnf_cli.batch_here import failure, register_here
from regnf_cli.console import EXIT_NOT_REGISTERED, EXIT_REGISTERED, err, fail, out, phase_progress
from regnf_cli.extras import require
from regnf_cli.options import Server, Token, WorkerTimeout

if TYPE_CHECKING:
    from regnf_client import Pair, PairResult

PairsFile = Annotated[
    Path,
    typer.Argument(
        help="JSON Lines, or CSV: scene, object, detection and more of each pair. Paths are relative to the file.",
        exists=True,
        dir_okay=False,
        metavar="PAIRS",
    ),
]
Results = Annotated[
    Path | None, typer.Option(help="Results, a JSON line each. By default beside the pairs: PAIRS.results.jsonl.")
]
Processes = Annotated[
    int | None, typer.Option("--jobs", min=1, help="Processes, of one thread each. By default one a core.")
]
_REASONS_SHOWN, _LINES_SHOWN = 8, 5


def batch(
    pairs: PairsFile,
    output: Results = None,
    jobs: Processes = None,
    server: Server = None,
    worker_timeout: WorkerTimeout = 60,
    token: Token = None,
) -> None:
    """Register many pairs; given again, the command goes on where it stopped, and does failed pairs again.

    Example: **regnf batch pairs.jsonl**, with a line for each pair such as
    `{"key": "a", "scene": "room.ckpt", "object": "chair.ckpt", "detection": {"min": [0, 0, 0], "max": [1, 1, 1]}}`

    Exit codes: 0 every pair has a result, 1 some failed, 2 bad input, 3 service unavailable.
    """
    if server is None:
        require("engine")
    target = output or pairs.with_suffix(".results.jsonl")
    listed = list(read_pairs(pairs))
    results = ResultsFile(target)
    left = [pair for pair in listed if not results.is_done(pair)]
    err.print(f"{len(listed)} pairs, {len(listed) - len(left)} done; results in {target}", markup=False, soft_wrap=True)
    sound = [pair for pair in left if pair.error is None]
    for pair in left:
        if pair.error is not None:
            results.add(pair, failure(pair.error))
    if server is None:
        ended = register_here(sound, min(jobs or os.cpu_count() or 1, max(1, len(sound))))
    else:
        ended = _at_service(sound, server, token, worker_timeout)
    if sound:
        _write(ended, results, len(sound))
    _show_failures(results.failures(listed))
    counts = results.counts(listed)
    out.print(", ".join(f"{count} {name}" for name, count in sorted(counts.items())) or "no pairs", markup=False)
    raise typer.Exit(EXIT_NOT_REGISTERED if counts["failed"] else EXIT_REGISTERED)


def _show_failures(failures: dict[str, list[dict[str, Any]]]) -> None:
    """Each reason once, with the lines that have it: the first of them in full."""
    for reason, told in list(failures.items())[:_REASONS_SHOWN]:
        first = told[0]["error"]
        lines = ", ".join(str(one["line"]) for one in told[:_LINES_SHOWN])
        more = f" and {len(told) - _LINES_SHOWN} more" if len(told) > _LINES_SHOWN else ""
        place = f"line {lines}" if len(told) == 1 else f"{len(told)} pairs, lines {lines}{more}; the first"
        fail(reason, f"{place}: {first['detail']}", hint=first.get("hint"))
    if len(failures) > _REASONS_SHOWN:
        err.print(f"and {len(failures) - _REASONS_SHOWN} other reasons, in the results", markup=False)


def _write(ended: Iterator[tuple[FilePair, dict[str, Any]]], results: ResultsFile, count: int) -> None:
    """Append results as they come."""
    try:
        with phase_progress() as bar:
            task = bar.add_task("registering", total=count)
            for pair, told in ended:
                results.add(pair, told)
                bar.advance(task)
    except KeyboardInterrupt:
        err.print("interrupted: the same command goes on from here", markup=False)
        raise


def _at_service(
    pairs: Sequence[FilePair], server: str, token: str | None, worker_timeout: int
) -> Iterator[tuple[FilePair, dict[str, Any]]]:
    from regnf_client import Client

    with Client(server, token, worker_timeout_s=worker_timeout or None) as client:
        for one in client.batch(_request(pair) for pair in pairs):
            yield pairs[one.index], _told(one)


def _request(pair: FilePair) -> Pair:
    from regnf_client import Pair

    asked = {"pictures": False, **(pair.request or {})}  # the command reads the numbers
    known = {name: asked.pop(name) for name in ("detection", "options", "seed")}
    objects: Any = list(pair.objects) if pair.is_search else pair.objects[0]
    return Pair(pair.scene, objects, known["detection"], known["options"] or None, known["seed"], more=asked)


def _told(one: PairResult) -> dict[str, Any]:
    if one.error is not None:
        return {"job": one.job, **failure(one.error)}
    kept = one.model_dump(exclude={"index", "key", "error", "number", "pair", "line"}, exclude_none=True)
    scales = {"T_scene_object": 1.0 / (one.scale or 1.0), "T_object_scene": one.scale}
    return kept | {name: {"matrix": kept[name], "scale": scale} for name, scale in scales.items()}
