"""A rendering done in this process, with a bar: what ``regnf render`` and ``regnf edit`` share."""

from __future__ import annotations

import os
from pathlib import Path

from regnf_cli.console import out, phase_progress
from regnf_core.field_source import FieldSource, find_source
from regnf_core.files import filled_folder, require_writable
from regnf_core.rendering.request import RenderRequest


def render_here(scene: FieldSource, request: RenderRequest, output: Path, jobs: int | None) -> None:
    """Write the request's files into ``output``, each whole or not at all. An object's name is its file.

    jobs: processes; None: one a core.
    """
    from regnf_core.fields.base import SdfField
    from regnf_core.loading import load_field
    from regnf_core.rendering.job import run_render

    require_writable(output)

    def open_object(name: str) -> SdfField:
        return load_field(find_source(Path(name))).field

    with phase_progress() as bar, filled_folder(output) as folder:
        task = bar.add_task("loading", total=1.0)
        field = load_field(scene).field
        bar.update(task, description="rendering")

        def tell(share: float) -> None:
            bar.update(task, completed=share)

        report = run_render(field, request, open_object, folder, tell, processes=jobs or os.cpu_count() or 1)
    for artifact in report.artifacts:
        out.print(str(output / artifact.name), markup=False, soft_wrap=True)
