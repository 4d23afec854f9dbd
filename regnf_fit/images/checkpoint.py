"""A fit's state on disk, so that an interrupted fit goes on as if it had not been."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import torch

from regnf_core.errors import InvalidInputError
from regnf_core.files import atomic_path

_VERSION = 4


def write_checkpoint(path: Path, state: dict[str, Any], key: str) -> None:
    """Write a trainer's state atomically. key: of the data and options that it belongs to."""
    with atomic_path(path, durable=True) as temporary, temporary.open("xb") as file:
        torch.save({"version": _VERSION, "key": key, "state": state}, file)


def read_checkpoint(path: Path, key: str) -> dict[str, Any]:
    """The state in ``path``. Raises InvalidInputError (CHECKPOINT_INVALID, CHECKPOINT_OF_ANOTHER_FIT)."""
    try:
        content = torch.load(path, weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, ValueError, KeyError) as error:
        raise InvalidInputError(f"{path.name} is not a checkpoint of a fit", reason="CHECKPOINT_INVALID") from error
    if not isinstance(content, dict) or content.get("version") != _VERSION:
        raise InvalidInputError(f"{path.name} is not a checkpoint of a fit", reason="CHECKPOINT_INVALID")
    if content.get("key") != key:
        raise InvalidInputError(
            f"{path.name} belongs to a fit of other data or options", reason="CHECKPOINT_OF_ANOTHER_FIT"
        )
    state: dict[str, Any] = content["state"]
    return state
