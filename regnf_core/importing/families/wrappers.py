"""Networks that somebody saved again: wrappers around a state dictionary, and what stands before its names.

DataParallel writes ``module.`` before each name and torch.compile ``_orig_mod.``; Lightning writes the name of the
attribute, and scripts put the dictionary into another one. Each family has its tensors at one place: they are put
there, so that no family needs to know of wrappers.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.pickle.pickle_machine import TensorRef

WRAPPED = re.compile(r"(?:(?<=\.)|^)(?:module|_orig_mod)\.")
_HOMES = (
    *(("pipeline", r"_model\.field\.glin\d"), ("model", r"neural_sdf\."), ("state_dict", r"model\.geometry\.")),
    *(("", r"net\.net\.\d+\.0\."), ("", r"final_layer\.0\.bias"), ("lin", r"lin0\.(weight|bias)")),
)
"""Where a family's trainer keeps its tensors ("": at the top), and which of their names tells it."""
_NEUS, _DEEPSDF = "sdf_network_fine", "model_state_dict"
"""Homes of layers ``lin*``."""
_OWN_NAMES = re.compile(r"(?:(?:model|net|network|decoder|sdf_network|sdf_network_fine)\.)*")
"""What may stand before ``lin*``: other networks have such layers too."""
_PLACES = ("", "pipeline", "model", "state_dict", _NEUS, _DEEPSDF)
_OTHERS = re.compile("colou?r|rgb|radiance|nerf")
_DEEPEST, _MOST = 3, 50_000


def unwrapped(checkpoint: Any, family: str | None) -> Any:
    """The checkpoint with its network at its family's place; as it is where none is found. family: the stated one.

    Raises FieldFormatError (FIELD_NOT_RECOGNIZED) for several networks, and for one that may be of two families.
    """
    if isinstance(checkpoint, (list, tuple)):
        parts = [part for part in checkpoint if isinstance(part, dict)]
        checkpoint = parts[0] if len(parts) == 1 else checkpoint
    if not isinstance(checkpoint, dict):
        return checkpoint
    found = {}
    # What lies at a home already comes first.
    for path, beside, state in sorted(_dictionaries(checkpoint), key=lambda one: one[0] not in _PLACES):
        named = {WRAPPED.sub("", name): value for name, value in state.items() if isinstance(name, str)}
        if (told := _home(named)) is not None:
            home, before = told
            if home == "lin" and _OTHERS.search(path):
                continue
            if home == "lin":
                home = _home_of_layers(path, before, {**checkpoint, **beside}, family)
            moved = {name.removeprefix(before): value for name, value in named.items() if name.startswith(before)}
            if path == home:  # nothing but that place counts
                return {**checkpoint, home: moved} if home else {**checkpoint, **moved}
            found[path] = {**checkpoint, **beside, **({home: moved} if home else moved)}
    if len(found) > 1:
        message = f"several networks fit: {', '.join(sorted(path[:40] for path in found))}; save one of them alone"
        raise FieldFormatError(message, reason="FIELD_NOT_RECOGNIZED")
    return next(iter(found.values()), checkpoint)


def _dictionaries(checkpoint: dict[Any, Any]) -> Iterator[tuple[str, dict[Any, Any], dict[Any, Any]]]:
    """Path, the dictionary around it, and each dictionary that has tensors."""
    waiting: list[tuple[str, dict[Any, Any], dict[Any, Any], int]] = [("", {}, checkpoint, 0)]
    left = _MOST
    while waiting:
        path, beside, state, depth = waiting.pop(0)
        if (left := left - len(state)) < 0:
            return
        if any(isinstance(value, TensorRef) for value in state.values()):
            yield path, beside, state
        if depth < _DEEPEST:
            inner = (
                (name, value) for name, value in state.items() if isinstance(name, str) and isinstance(value, dict)
            )
            waiting += [(f"{path}.{name}" if path else name, state, value, depth + 1) for name, value in inner]


def _home(named: dict[str, Any]) -> tuple[str, str] | None:
    """The home of these tensors, "lin" for layers of two families, and what stands before their names."""
    for home, pattern in _HOMES:
        search = re.compile(rf"(?:(?<=\.)|^){pattern}").search
        hits = (search(name) for name, value in named.items() if isinstance(value, TensorRef))
        hit = next((one for one in hits if one is not None), None)
        if hit is not None:
            before = hit.string[: hit.start()]
            return (home, before) if home != "lin" or _OWN_NAMES.fullmatch(before) else None
    return None


def _home_of_layers(path: str, before: str, beside: dict[Any, Any], family: str | None) -> str:
    if (name := path.rpartition(".")[2]) in (_NEUS, _DEEPSDF):
        return name
    if family == "neus" or (family is None and "sdf_network" in f"{path}.{before}"):
        return _NEUS
    if family == "deepsdf" or "latent_codes" in beside:
        return _DEEPSDF
    message = 'layers lin*, of NeuS or of DeepSDF: give the import option {"family": "neus"} or {"family": "deepsdf"}'
    raise FieldFormatError(message, reason="FIELD_NOT_RECOGNIZED")
