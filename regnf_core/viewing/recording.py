"""A recording of a registration for the viewer of rerun (https://rerun.io), which the extra ``rerun`` brings."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from regnf_core.document import RegistrationResult
from regnf_core.errors import RECORDING_SUFFIX, MissingExtraError, atomic_path, made_folder, new_file
from regnf_core.geometry.box import OrientedBox


def write_recording(
    result: RegistrationResult,
    path: str | Path,
    detection: OrientedBox | None = None,
    object_name: str | None = None,
) -> Path:
    """Write the recording of a result with clouds, whole or not at all; its path.

    detection: scene frame, drawn if it is known · object_name: for the text of the verdict.
    Neither is a viewer started nor a connection opened.
    Raises MissingExtraError, InvalidOptionsError (no name of a recording), InvalidInputError (FILE_IS_FOLDER,
    RECORDING_DISABLED), OSError.
    """
    target = new_file(path, RECORDING_SUFFIX)
    if find_spec("rerun") is None:
        raise MissingExtraError.of(["rerun"], ["rerun"])
    from regnf_core.viewing.recording_content import recorded

    content = recorded(result, detection, object_name)
    with made_folder(target.parent), atomic_path(target) as part:
        part.write_bytes(content)
    return target
