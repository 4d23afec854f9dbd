"""The examples of regnf_core/importing/families/README.md: a family in two files, and a kind."""

from __future__ import annotations

import re
import sys
import textwrap
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from regnf_core.fields.build import open_field
from regnf_core.importing import families
from regnf_core.importing.gate.convert import convert_file
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.schema.tensor_check import TensorSpec

PAGE = Path(__file__).resolve().parents[3] / "regnf_core" / "importing" / "families" / "README.md"


def example(path: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The module that the page shows under ``path``, loaded under the name it would have."""
    blocks = re.findall(r"^( *)```python\n(.*?)^\1```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    (source,) = (text for _, text in blocks if path in text.splitlines()[0])
    module = ModuleType(path.removesuffix(".py").replace("/", "."))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(compile(textwrap.dedent(source), path, "exec"), vars(module))
    return module


def test_a_family_is_one_module_and_one_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lattice = example("regnf_core/importing/families/lattice.py", monkeypatch)
    monkeypatch.setattr(families, "FAMILIES", (*families.FAMILIES[:-1], lattice.convert))
    axis = torch.linspace(-1.0, 1.0, 33)
    nodes = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    torch.save({"lattice": nodes.norm(dim=-1) - 0.5, "half_edge": 1.0}, tmp_path / "ball.pt")
    report = convert_file(tmp_path / "ball.pt", tmp_path, {"world_scale": 2.0}, ImportLimits())
    assert (report["family"], report["kind"]) == ("lattice", "voxel_grid")
    field = open_field(tmp_path / "field.safetensors")
    distance = field.signed_distance(torch.tensor([[1.5, 0.0, 0.0], [0.0, 0.0, 0.75]]))
    torch.testing.assert_close(distance, torch.tensor([0.5, -0.25]), rtol=0, atol=0.01)


def test_a_kind_is_a_description_and_an_evaluator(monkeypatch: pytest.MonkeyPatch) -> None:
    described = example("regnf_core/schema/spheres.py", monkeypatch)
    evaluator = example("regnf_core/fields/spheres.py", monkeypatch)
    description = described.SpheresDescription(kind="spheres", bounds=((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)))
    spheres = np.array([[0.0, 0.0, 0.0, 0.5], [1.0, 0.0, 0.0, 0.25]], np.float32)
    description.check({"spheres": TensorSpec(spheres.shape, "F32")})
    field = evaluator.build_spheres(description, {"spheres": torch.from_numpy(spheres)})
    distance, gradient = field.signed_distance_and_gradient(torch.tensor([[0.0, 0.7, 0.0], [1.5, 0.0, 0.0]]))
    torch.testing.assert_close(distance, torch.tensor([0.2, 0.25]))
    torch.testing.assert_close(gradient, torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]))
