"""``regnf batch``: many registrations from one file, here or on a server."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from regnf_cli.batch_file import FilePair, ResultsFile, read_pairs
from regnf_cli.guard import require
from regnf_cli.options import Server, Token, WorkerTimeout, client_of, is_recording
from regnf_cli.registration import place_of
from regnf_cli.report import EXIT_NOT_REGISTERED, EXIT_REGISTERED, err, fail, out, progress, tell
from regnf_core.detections.images import read_detection
from regnf_core.errors import InvalidInputError, RegnfError
from regnf_core.field_source import find_source
from regnf_core.options import RegistrationOptions, RobustOptions
from regnf_core.pairs import short_result
from regnf_core.processes import die_with_parent

if TYPE_CHECKING:
    from regnf_client import Client, PairResult
    from regnf_core.fields.observation import SdfField
    from regnf_core.library import ObjectModel
    from regnf_data.recordings.recording import Recording


# Registering many pairs here: processes that keep fields and object models open from one pair to the next.

_FIELDS_OPEN = 16
_MODELS_HELD = 256
_TRIES = 2
"""How often a pair is begun whose process died: another pair of the same moment may have been the cause."""
logger = logging.getLogger(__name__)


def register_here(pairs: Sequence[FilePair], processes: int) -> Iterator[tuple[FilePair, dict[str, Any]]]:
    """The result of each pair as it comes. Pairs of one scene and object follow each other, so that both stay open."""
    ordered = sorted(pairs, key=lambda pair: (pair.scene, pair.objects, pair.line))
    if processes == 1:
        yield from ((pair, register_pair(pair)) for pair in ordered)
    else:
        yield from _in_processes(ordered, processes)


def _in_processes(pairs: Sequence[FilePair], processes: int) -> Iterator[tuple[FilePair, dict[str, Any]]]:
    """Results until all pairs are done. When a process dies, those that were begun are begun once more."""
    waiting = deque((pair, 1) for pair in pairs)
    while waiting:
        running: dict[Future[dict[str, Any]], tuple[FilePair, int]] = {}
        lost: list[FilePair] = []
        pool = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _begin, (os.getpid(),))
        try:
            while waiting or running:
                while waiting and len(running) < 2 * processes:
                    with _kept_from_children():
                        future = pool.submit(register_pair, waiting[0][0])
                    running[future] = waiting.popleft()
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    told = future.result()
                    yield running.pop(future)[0], told
        except BrokenProcessPool:
            waiting.extendleft((pair, tries + 1) for pair, tries in running.values() if tries < _TRIES)
            lost = [pair for pair, tries in running.values() if tries == _TRIES]
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in multiprocessing.active_children():  # in the midst of a pair that nobody waits for any more
                child.kill()
        for pair in lost:
            hint = "Check that there is enough memory."
            error = InvalidInputError("the process died", reason="WORKER_LOST", hint=hint)
            yield pair, failure(error)


@contextmanager
def _kept_from_children() -> Iterator[None]:
    """Processes that begin meanwhile never get a terminal's signals: this one has them, and ends the others."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGHUP))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(parent: int) -> None:
    """One thread each: the processes share the cores."""
    die_with_parent(parent)
    os.environ["OMP_NUM_THREADS"] = "1"
    import torch

    torch.set_num_threads(1)


def register_pair(pair: FilePair) -> dict[str, Any]:
    """What the results say of a pair. Nothing that is wrong with it is raised."""
    try:
        return {"status": "successful", **short_result(_document(pair))}
    except RegnfError as error:
        return failure(error)
    except OSError as error:
        return failure(InvalidInputError(str(error), reason="FILE_UNUSABLE"))
    except Exception as error:
        logger.exception("line %d: an internal error", pair.line)
        return failure(InvalidInputError(f"an internal error: {type(error).__name__}", reason="INTERNAL"))


def failure(error: RegnfError) -> dict[str, Any]:
    """What the results say of a pair without a result."""
    told = {"reason": error.reason, "detail": str(error)} | ({"hint": error.hint} if error.hint else {})
    return {"status": "failed", "error": told}


def _document(pair: FilePair) -> dict[str, Any]:
    from regnf_core.document import ranking_document, result_document
    from regnf_core.geometry.sim3 import Sim3
    from regnf_core.library import LibraryObject, register, search_library

    request = pair.request or {}
    options = RegistrationOptions.from_dict(request["options"])
    where = partial(place_of, _scene(pair.scene), read_detection(request["detection"]), options, Path(pair.scene))
    start, truth = request.get("initial_transform"), (request.get("ground_truth") or {}).get("T_object_scene")
    if pair.is_search:
        _require_nothing_of_one_object(request)
        samples = options.robust.object_samples
        library = [LibraryObject(one, partial(_field, one, "object"), _model(one, samples)) for one in pair.objects]
        place = where()
        found = search_library(place.field, place.box, library, place.options, request["seed"], clouds=False)
        ranking = ranking_document(found.ranking, {})
        return dict(result_document(place.seen(found.result), object_name=found.ranking[0].name, candidates=ranking))
    (name,) = pair.objects
    model = _model(name, options.robust.object_samples) if options.preset == "robust" else None
    initial = None if start is None else Sim3.from_matrix(start)
    # errors against a truth are those of the clouds' points
    clouds = truth is not None
    obj = _field(name, "object")
    place = where(obj, model)
    result = register(place.field, obj, place.box, place.options, request["seed"], None, initial, model, clouds)
    return dict(result_document(place.seen(result), None if truth is None else Sim3.from_matrix(truth)))


def _require_nothing_of_one_object(request: Mapping[str, Any]) -> None:
    """Raises InvalidInputError, as a service refuses such a line."""
    reasons = {"initial_transform": "PRESET_UNSUITABLE", "ground_truth": "INVALID_REQUEST"}
    for name, reason in reasons.items():
        if request.get(name) is not None:
            hint = f"Leave `{name}` out, or give `object` instead of `candidates`."
            message = f"`{name}` applies to one object, not to several candidates"
            raise InvalidInputError(message, reason=reason, hint=hint)


@lru_cache(_FIELDS_OPEN)
def _scene(path: str) -> SdfField | Recording:
    if is_recording(Path(path)):
        from regnf_data.recordings.opening import open_recording

        return open_recording(path)
    return _field(path, "scene")


@lru_cache(_FIELDS_OPEN)
def _field(path: str, role: Any) -> SdfField:
    from regnf_core.loading import load_field

    return load_field(find_source(Path(path), role=role)).field


@lru_cache(_MODELS_HELD)
def _model(path: str, samples: int) -> ObjectModel:
    from regnf_core.object_models import object_model

    return object_model(find_source(Path(path), role="object"), replace(RobustOptions(), object_samples=samples))


Results = Annotated[
    Path | None,
    typer.Option(help="File for the results, one JSON line per pair. Default: PAIRS.results.jsonl next to the pairs."),
]
Processes = Annotated[
    int | None, typer.Option(min=1, help="Number of processes, each with one thread. Default: one per core.")
]
_REASONS_SHOWN, _LINES_SHOWN = 8, 5


def batch(
    pairs: Annotated[
        Path,
        typer.Argument(
            help="File with the pairs, JSON Lines or CSV: scene, object, detection and optional members of "
            "each pair. Paths are relative to this file.",
            exists=True,
            dir_okay=False,
            metavar="PAIRS",
        ),
    ],
    output: Results = None,
    processes: Processes = None,
    server: Server = None,
    worker_timeout: WorkerTimeout = 60,
    token: Token = None,
) -> None:
    """Register many pairs. The same command again continues after an interruption and repeats failed pairs.

    Example: **regnf batch pairs.jsonl**, with one line per pair, for example
    `{"key": "a", "scene": "room.ckpt", "object": "chair.ckpt", "detection": {"min": [0, 0, 0], "max": [1, 1, 1]}}`

    Exit codes: 0 all pairs have a result, 1 some pairs failed, 2 bad input, 3 service unavailable.
    """
    if server is None:
        require("engine")
    target = output or pairs.with_suffix(".results.jsonl")
    listed = list(read_pairs(pairs))
    results = ResultsFile(target)
    left = [pair for pair in listed if not results.is_done(pair)]
    tell(f"{len(listed)} pairs, {len(listed) - len(left)} done; results in {target}")
    sound = [pair for pair in left if pair.error is None]
    for pair in left:
        if pair.error is not None:
            results.add(pair, failure(pair.error))
    client = client_of(server, token, worker_timeout)
    if client is None:
        ended = register_here(sound, min(processes or os.cpu_count() or 1, max(1, len(sound))))
    else:
        ended = _at_service(sound, client)
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
        err.print(f"and {len(failures) - _REASONS_SHOWN} other reasons; see the results", markup=False)


def _write(ended: Iterator[tuple[FilePair, dict[str, Any]]], results: ResultsFile, count: int) -> None:
    try:
        with progress() as bar:
            task = bar.add_task("registering", total=count)
            for pair, told in ended:
                results.add(pair, told)
                bar.advance(task)
    except KeyboardInterrupt:
        tell("interrupted: run the same command again to continue")
        raise


def _at_service(pairs: Sequence[FilePair], client: Client) -> Iterator[tuple[FilePair, dict[str, Any]]]:
    with client:
        for one in client.batch(_request(pair) for pair in pairs):
            yield pairs[one.index], _told(one)


def _request(pair: FilePair) -> dict[str, Any]:
    request = dict(pair.request or {})
    named = {"candidates": list(pair.objects)} if pair.is_search else {"object": pair.objects[0]}
    # the command reads the numbers: no pictures, unless the line says so
    return {"scene": pair.scene, **named, "pictures": False, **request, "options": request["options"] or None}


def _told(one: PairResult) -> dict[str, Any]:
    if one.error is not None:
        return {"job": one.job, **failure(one.error)}
    kept = one.model_dump(exclude={"index", "key", "error", "number", "pair", "line"}, exclude_none=True)
    scales = {"T_scene_object": 1.0 / (one.scale or 1.0), "T_object_scene": one.scale}
    return kept | {name: {"matrix": kept[name], "scale": scale} for name, scale in scales.items()}
