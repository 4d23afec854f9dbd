"""A rendering done in this process, with a bar: what ``regnf render`` and ``regnf edit`` share."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from regnf_cli.console import out, phase_progress
from regnf_core.field_source import FieldSource, find_source
from regnf_core.rendering.request import RenderRequest


def render_here(scene: FieldSource, request: RenderRequest, output: Path, jobs: int | None) -> None:
    """Write the request's files into ``output``, each whole or not at all. An object's name is its file.

    jobs: processes; None: one a core.
    """
    from regnf_core.fields.base import SdfField
    from regnf_core.loading import load_field
    from regnf_core.rendering.job import run_render

    output.mkdir(parents=True, exist_ok=True)

    def open_object(name: str) -> SdfField:
        return load_field(find_source(Path(name))).field

    with phase_progress() as bar, tempfile.TemporaryDirectory(dir=output) as folder:
        task = bar.add_task("loading", total=1.0)
        field = load_field(scene).field
        bar.update(task, description="rendering")

        def tell(share: float) -> None:
            bar.update(task, completed=share)

        report = run_render(field, request, open_object, Path(folder), tell, processes=jobs or os.cpu_count() or 1)
        for artifact in report.artifacts:
            (Path(folder) / artifact.name).replace(output / artifact.name)
    for artifact in report.artifacts:
        out.print(str(output / artifact.name), markup=False, soft_wrap=True)
