"""Options and arguments that several commands have, each declared once: the types of those commands' parameters.

The name of an option is its parameter's. Its default stands in the command's signature.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from regnf_cli.field_options import CONFIG, DESCRIPTION
from regnf_cli.paths import FIELD, JSON_FILE, OUTPUT, RECORDING

# a field by itself

Field = Annotated[Path, typer.Argument(help="A file, a training run's folder or an archive of one.", **FIELD)]
Description = Annotated[
    dict[str, Any] | None, typer.Option(help="What the file does not say: a file or JSON.", **DESCRIPTION)
]
Config = Annotated[
    Path | None, typer.Option(help="The settings that the field was trained with: a file or an archive.", **CONFIG)
]
NoConfig = Annotated[bool, typer.Option("--no-config", help="Leave settings that lie beside the checkpoint unread.")]

# a scene, what stands in it, and where

Scene = Annotated[
    Path,
    typer.Argument(help="The scene's field: a file, a run's folder or an archive.", **FIELD | {"metavar": "SCENE"}),
]
DetectionFile = Annotated[
    Path, typer.Option(help="JSON: the box in the scene's frame and units, in any common form.", **JSON_FILE)
]
DetectionIndex = Annotated[
    int | None, typer.Option(min=0, help="Which one, where the file holds a list of detections; 0 is the first.")
]
SceneConfig = Annotated[
    Path | None, typer.Option(help="The settings that the scene was trained with: a file or an archive.", **CONFIG)
]
NoConfigs = Annotated[bool, typer.Option("--no-config", help="Leave settings that lie beside a checkpoint unread.")]
SceneDescription = Annotated[
    dict[str, Any] | None, typer.Option(help="What the scene's file does not say: a file or JSON.", **DESCRIPTION)
]

# the work and its result

Seed = Annotated[int, typer.Option(min=0, max=2**32 - 1)]
Output = Annotated[Path | None, typer.Option(help="Folder for the result, point clouds and pictures.", **OUTPUT)]
Recording = Annotated[
    Path | None,
    typer.Option(help="File (.rrd) for a recording to look at in the viewer of rerun. Needs its extra.", **RECORDING),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the whole result document.")]

# a service elsewhere

Server = Annotated[str | None, typer.Option(help="Address of a regnf service; without it the work is done here.")]
WorkerTimeout = Annotated[
    int, typer.Option(min=0, help="With --server: seconds to wait for a worker before giving up.")
]
CancelOnInterrupt = Annotated[
    bool, typer.Option("--cancel-on-interrupt", help="With --server: Ctrl+C cancels the job; it goes on otherwise.")
]
Token = Annotated[
    str | None,
    typer.Option(
        envvar="REGNF_API_TOKEN",
        help="The service's bearer token.",
        # `$(cat FILE)` keeps the mark and the carriage return of a file that Windows wrote
        parser=lambda text: text.strip("\ufeff \t\r\n"),
        metavar="TOKEN",
    ),
]
