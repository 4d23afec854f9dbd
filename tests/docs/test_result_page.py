"""docs/reference/result.md explains every key of a result, and no key that there is not."""

from __future__ import annotations

import json
import re
import types
import typing
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from regnf_core.document import ResultDocument, TransformDocument
from tests.cli.conftest import Run, demo, run
from tests.docs.pages import DOCS, ROOT

__all__ = ["demo", "run"]
FRAME = ROOT / "examples" / "data" / "frame"
OPEN = ("metrics", "options", "used")
"""Their keys are tables of other pages, or a trainer's."""


def explained() -> set[str]:
    """The keys in the first column of the page's tables up to its list of files; of transforms, their own table."""
    page = (DOCS / "reference" / "result.md").read_text(encoding="utf-8").partition("## The files beside it")[0]
    firsts = re.findall(r"^\| (`[^|]*) \|", page, flags=re.M)
    return {key for first in firsts for key in re.findall(r"`([^`]+)`", first)}


def keys_of(value: Any, above: str = "") -> set[str]:
    """Of JSON values: `a`, `a.b`, `a[].b`. Those of a transform by themselves."""
    if isinstance(value, list):
        return {key for one in value for key in keys_of(one, f"{above}[]")}
    if not isinstance(value, dict):
        return set()
    if set(value) == set(TransformDocument.model_fields):
        return set(value)
    found = set()
    for name, part in value.items():
        path = f"{above}.{name}".lstrip(".")
        found |= {path} if name in OPEN else {path} | keys_of(part, path)
    return found


def keys_of_model(model: type[BaseModel], above: str = "") -> set[str]:
    found = set()
    for name, field in model.model_fields.items():
        path = f"{above}.{name}".lstrip(".")
        found |= {path} | keys_of_type(field.annotation, path)
    return found


def keys_of_type(kind: Any, path: str) -> set[str]:
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return set(TransformDocument.model_fields) if kind is TransformDocument else keys_of_model(kind, path)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is list:
        return keys_of_type(arguments[0], f"{path}[]")
    if origin is dict and typing.get_origin(arguments[0]) is typing.Literal:
        named = [f"{path}.{name}" for name in typing.get_args(arguments[0])]
        return set(named) | {key for name in named for key in keys_of_type(arguments[1], name)}
    if origin in (typing.Union, types.UnionType, typing.Annotated):
        return {key for one in arguments for key in keys_of_type(one, path)}
    return set()


def test_the_page_has_the_keys_of_the_contract_and_no_others() -> None:
    engine = {f"engine.{name}" for name in ("name", "version", "device", "torch")}
    assert explained() == keys_of_model(ResultDocument) | engine


def test_the_page_has_the_keys_of_real_results(tmp_path: Path, run: Run, demo: list[object]) -> None:
    room, frame = tmp_path / "room", tmp_path / "frame"
    run(*demo, "--output", room, code=0)
    image = ["register", FRAME, FRAME / "cat.stl", "--detection", FRAME / "mask.json", "--object-unit", "mm"]
    run(*image, "--output", frame, code=0)
    metrics = (DOCS / "reference" / "metrics.md").read_text(encoding="utf-8")
    files = (DOCS / "reference" / "result.md").read_text(encoding="utf-8").partition("## The files beside it")[2]
    for folder in (room, frame):
        result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        assert keys_of(result) <= explained()
        assert len(keys_of(result)) > 40
        assert {name for name in result["metrics"] if f"`{name}`" not in metrics} == set()
        assert {file.name for file in folder.iterdir() if f"`{file.name}`" not in files} == {"result.json"}
