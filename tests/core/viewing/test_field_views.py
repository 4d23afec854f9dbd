"""What a worker leaves of a field for people to look at."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from regnf_core.importing.gate.gate import import_field
from regnf_core.viewing import field_views as module
from regnf_core.viewing.field_views import field_views


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ball")
    axis = np.linspace(-1.0, 1.0, 24, dtype=np.float32)
    values = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1), axis=-1) - np.float32(0.5)
    np.savez(folder / "ball.npz", sdf=values, bounds=np.array([[-1.0] * 3, [1.0] * 3]))
    import_field(folder / "ball.npz", folder / "out")
    return folder / "out" / "field.safetensors"


def test_a_field_is_drawn(ball: Path) -> None:
    found = field_views(ball)
    assert found.fine is not None
    assert found.coarse is not None
    assert found.picture is not None
    assert found.fine[:4] == found.coarse[:4] == b"glTF"
    assert len(found.coarse) < len(found.fine)
    assert found.picture.startswith(b"\x89PNG")


def test_a_field_that_is_too_slow_has_nothing_to_look_at(ball: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_BUDGET_S", 0.0)
    assert field_views(ball) == module.FieldViews(None, None, None)
