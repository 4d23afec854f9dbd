"""``regnf fit``: a neural field from a mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, Progress, TextColumn

from regnf_cli.console import err, out


def fit(
    mesh: Annotated[Path, typer.Argument(help="A mesh: glb, obj, ply, stl.", exists=True)],
    output: Annotated[Path, typer.Argument(help="The safe field to write, *.safetensors.")],
    iterations: Annotated[int | None, typer.Option(min=1, help="Training steps; more is finer.")] = None,
    table_log2: Annotated[int | None, typer.Option(min=8, max=22, help="log2 of the entries per hash level.")] = None,
    label: Annotated[str | None, typer.Option(help="A name kept in the file.")] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
) -> None:
    """Fit a neus-facto field to the exact distance of a mesh, in the mesh's own frame and units normalised.

    Example: **regnf fit chair.glb chair.safetensors --iterations 2000**
    """
    from regnf_core.fitting import FitOptions, fit_mesh

    given = {"iterations": iterations, "log2_table_size": table_log2}
    options = FitOptions(**{name: value for name, value in given.items() if value is not None})
    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}")
    with Progress(*columns, console=err) as bar:
        task = bar.add_task("fitting", total=options.iterations, state="sampling distances")

        def report(iteration: int, loss: float, seconds_left: float) -> None:
            bar.update(task, completed=iteration, state=f"loss {loss:.5f}, {seconds_left:.0f} s left")

        figures = fit_mesh(mesh, output, options, seed=seed, label=label, progress=report)
    for name, value in figures.items():
        out.print(f"{name:<28} {value}")
