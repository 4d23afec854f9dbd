"""A random world that several tests look at."""

from __future__ import annotations

from pathlib import Path

import pytest
import trimesh

from benchmarks.worlds.making import Task, make


@pytest.fixture(scope="session")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with twelve things."""
    folder = tmp_path_factory.mktemp("meshes")
    for number in range(12):
        trimesh.creation.icosphere(radius=0.08 + 0.01 * number).export(folder / f"ball{number}.ply")
    return folder


@pytest.fixture(scope="session")
def world(meshes: Path, tmp_path_factory: pytest.TempPathFactory) -> Task:
    """One that is made already."""
    task = Task(12, "single", "mesh", (meshes,), tmp_path_factory.mktemp("worlds"))
    make(task)
    return task
