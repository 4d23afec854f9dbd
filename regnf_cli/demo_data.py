"""Where the demo's fields lie: in the installed package, or in a checkout's examples folder."""

from __future__ import annotations

from pathlib import Path

from regnf_core.errors import InvalidInputError

_PACKAGED = Path(__file__).with_name("demo_files")
_CHECKOUT = Path(__file__).resolve().parents[1] / "examples" / "data"
FILES = ("mix-room.safetensors", "armchair.safetensors", "detection.json", "truth.json")
"""What the demo needs; the build of the wheel copies these files into the package."""


def demo_folder() -> Path:
    """The folder that holds all of ``FILES``. Raises InvalidInputError (DEMO_DATA_MISSING)."""
    for folder in (_PACKAGED, _CHECKOUT):
        if all((folder / name).is_file() for name in FILES):
            return folder
    raise InvalidInputError(
        f"the demo's files ({', '.join(FILES)}) are neither in {_PACKAGED} nor in {_CHECKOUT}; "
        "install regnf from its wheel or run from a checkout",
        reason="DEMO_DATA_MISSING",
    )
