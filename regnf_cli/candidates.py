"""What a file may be, where nothing in it tells: each with what to add to the command, and pictures on demand."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from pathlib import Path

from regnf_cli.console import err
from regnf_core.errors import RegnfError
from regnf_core.field_candidates import Candidate, Said
from regnf_core.files import filled_folder


def show_candidates(error: RegnfError) -> None:
    """Say on stderr what to add to the command for each function that a refused file may be, if that is why."""
    asked: Sequence[Candidate] = getattr(error, "candidates", ())
    said: Said = getattr(error, "said", None) or Said(None, {})
    option = "--description" if said.use is None else f"--{said.use}-description"
    for number, one in enumerate(asked, 1):
        whole = one.added_to(said.description)
        err.print(f"{number}  {one.name}", markup=False, soft_wrap=True)
        err.print(f"   {option} {shlex.quote(json.dumps(whole))}", markup=False, soft_wrap=True)


def keep_pictures(asked: Sequence[Candidate], folder: Path) -> None:
    """Write the candidates' pictures, 1.png and so on as they are numbered; the folder is made if need be."""
    pictures = {f"{number}.png": one.picture for number, one in enumerate(asked, 1) if one.picture is not None}
    with filled_folder(folder) as work:
        for name, picture in pictures.items():
            (work / name).write_bytes(picture)
    for name in pictures:
        err.print(f"wrote {folder / name}", markup=False, soft_wrap=True)
