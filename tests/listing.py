"""What lies in a folder that others write into. What goes meanwhile is no error; pathlib's glob raises then."""

from __future__ import annotations

import os
from pathlib import Path


def below(folder: Path) -> list[Path]:
    """Every file and folder below this one, at whatever depth, in their order; none if it is not there."""
    places = ((Path(place), [*folders, *files]) for place, folders, files in os.walk(folder))
    return sorted(place / name for place, names in places for name in names)


def files_below(folder: Path) -> list[Path]:
    """Every file below this one, at whatever depth, in their order."""
    return [path for path in below(folder) if path.is_file()]
