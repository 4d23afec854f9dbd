"""docs/environment.md says what the settings are, docs/deployment.md what the compose file takes."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from regnf_state.settings import Fixed, Settings
from tests.docker.files import COMPOSE, ROOT

DEPLOYMENT = (ROOT / "docs" / "deployment.md").read_text()
ENVIRONMENT = (ROOT / "docs" / "environment.md").read_text()
ROW = re.compile(r"^\| `(REGNF_\w+|PIP_\w+|GRAFANA_\w+)` \| `?([^|`]*)`? \| (.+) \|$", re.MULTILINE)


def written(value: Any) -> str:
    """A default as the table writes it."""
    if value is None:
        return "unset"
    if isinstance(value, bool | int | float):
        return json.dumps(value)
    return "[]" if value == frozenset() else str(value)


def test_every_setting_is_in_the_table_with_its_default(monkeypatch: pytest.MonkeyPatch) -> None:
    names = [name for name in Settings.model_fields if name not in Fixed.model_fields]
    assert len(names) <= 45
    for name in names:
        monkeypatch.delenv(f"REGNF_{name.upper()}", raising=False)
    monkeypatch.delenv("XDG_STATE_HOME", raising=False)
    settings = Settings()
    documented = {name: default for name, default, _ in ROW.findall(ENVIRONMENT)}
    expected = {f"REGNF_{name.upper()}": written(getattr(settings, name)) for name in names}
    expected["REGNF_STATE_DIR"] = expected["REGNF_STATE_DIR"].replace(str(Path.home()), "~")
    assert documented == expected


def test_every_variable_of_the_compose_file_is_explained() -> None:
    explained = {name: default for name, default, _ in ROW.findall(DEPLOYMENT)}
    used = dict(re.findall(r"\$\{(\w+):-([^}]*)\}", COMPOSE.read_text()))
    assert {name: default or "empty" for name, default in used.items()} == explained
