"""A file of Gaussian splats moved by a pose, outside of the importer: for files that are the user's own."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError, InvalidInputError
from regnf_core.importing.containers.sniff import HEAD_BYTES, explain_refusal, splat_format
from regnf_core.importing.families.gaussian_splats import read_splats
from regnf_core.importing.run.opened import open_upload
from regnf_core.importing.splats.gaussians import Doubles, Splats, sound, write_ply
from regnf_core.rotations import similarity_fault

_MOST = 4 << 30
"""Bytes that an archive is unpacked to."""


def read_splat_file(path: str | os.PathLike[str]) -> Splats:
    """The Gaussians of a file of any format that is imported, as they are stored.

    Raises FieldFormatError: MESH_INVALID, FORMAT_NOT_SUPPORTED, FORMAT_NOT_RECOGNIZED and the reasons of archives; and
    OSError.
    """
    named = Path(path)
    data = memoryview(named.read_bytes())
    with tempfile.TemporaryDirectory() as folder:
        opened = open_upload(data, Path(folder), _MOST)
        kind = splat_format(opened.data)
        if kind is None:
            reason, detail = explain_refusal(bytes(data[:HEAD_BYTES]))
            detail = detail if reason != "FORMAT_NOT_RECOGNIZED" else "no Gaussian splats"
            raise FieldFormatError(f"{named.name}: {detail}", reason=reason)
        return sound(read_splats(kind, opened.data, opened.siblings))[0]


def pose_in(path: Path, inverse: bool) -> Doubles:
    """The similarity (4, 4) in a JSON file: a matrix, or a result of a registration, whose T_object_scene is taken,
    with ``inverse`` its T_scene_object. Raises InvalidInputError (INVALID_OPTIONS) for anything else, and OSError.
    """
    try:
        said: Any = json.loads(path.read_text("utf-8-sig"))
        for name in ("T_object_scene", "matrix"):
            said = said[name] if isinstance(said, dict) and name in said else said
        rows = [[float(value) for value in row] for row in said]
        fault = similarity_fault(rows)
    except (ValueError, TypeError, RecursionError) as error:
        raise InvalidInputError(f"{path.name}: no 4 x 4 matrix and no result", reason="INVALID_OPTIONS") from error
    if fault is not None:
        raise InvalidInputError(f"{path.name}: {fault}", reason="INVALID_OPTIONS")
    matrix = np.array(rows)
    return np.linalg.inv(matrix) if inverse else matrix


def write_moved(source: Path, target: Path, transform: Doubles) -> int:
    """Write the splats of ``source``, moved by the similarity (4, 4), as PLY. Returns how many there are."""
    splats = read_splat_file(source).moved(transform)
    target.write_bytes(write_ply(splats))
    return len(splats)
