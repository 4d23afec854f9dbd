"""Where the development data lies (open meshes, room layouts, reference checkpoints), if it does."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def dev_data(*parts: str) -> Path:
    """The path of a development file; the calling test is skipped, visibly, where there is none."""
    base = Path(os.environ.get("REGNF_DEV_DATA", ROOT.parent / "shared" / "data"))
    path = base.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"development data not present: {'/'.join(parts)} (set REGNF_DEV_DATA)")
    return path
