"""``regnf fit`` of a folder of posed images."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, Progress, TextColumn

from regnf_cli.console import err
from regnf_cli.fit_options import print_report
from regnf_core.errors import InvalidOptionsError


def fit_images(
    dataset: Path, output: Path, settings: dict[str, Any], extra: dict[str, Any], rest: dict[str, Any]
) -> None:
    """Fit to the images in ``dataset``.

    settings: of ReconstructionOptions · extra: ``snapshots``, percents between commas, and ``sdfstudio``, a path, or
    None each; ``pictures``, whether to draw; ``opengl``, the cameras' axes · rest: what ``reconstruct`` takes beside.
    """
    from regnf_data.sdfstudio import load_dataset
    from regnf_fit.images.fit import FitFiles, reconstruct
    from regnf_fit.images.options import ReconstructionOptions

    options = ReconstructionOptions(**settings)
    files = FitFiles(
        output,
        output.with_suffix(".checkpoint"),
        shares(extra["snapshots"]),
        pictures=extra["pictures"],
        sdfstudio=extra["sdfstudio"],
    )
    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}")
    with Progress(*columns, console=err) as bar:
        task = bar.add_task("fitting", total=1.0, state="reading the images")
        images = load_dataset(dataset, opengl=extra["opengl"])

        def report(iteration: int, loss: float, seconds_left: float) -> None:
            elapsed = time.monotonic() - started
            state = f"iteration {iteration}, loss {loss:.5f}, {seconds_left:.0f} s left"
            bar.update(task, completed=elapsed / max(elapsed + seconds_left, 1e-9), state=state)

        bar.update(task, state="laying out the rays")
        started = time.monotonic()
        figures = reconstruct(
            images, files, options, progress=report, source={"dataset": dataset.resolve().name}, **rest
        )
    print_report(asdict(figures))


def shares(percents: str | None) -> tuple[float, ...]:
    """Percents such as ``1,3,10`` as shares. Raises InvalidOptionsError."""
    if not percents:
        return ()
    try:
        values = tuple(float(part) / 100.0 for part in percents.split(","))
    except ValueError as error:
        raise InvalidOptionsError(f"snapshots are percents such as 1,3,10, not {percents:.40}") from error
    if not all(0.0 < value < 1.0 for value in values):
        raise InvalidOptionsError("snapshots lie between 0 and 100 percent")
    return values
