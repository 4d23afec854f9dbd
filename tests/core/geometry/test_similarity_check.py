"""The torch-free check of a similarity: what it refuses, and that the engine takes whatever it lets through."""

from __future__ import annotations

import json
from typing import Any

import pytest
import torch

from regnf_core.errors import InvalidInputError
from regnf_core.geometry.sim3 import Sim3
from regnf_core.rotations import TOLERANCE, similarity_fault

NAN, INF = float("nan"), float("inf")


def rows(**changes: Any) -> list[list[Any]]:
    """A turn of 90 degrees about z at scale 2, with entries changed: m12=... is row 1, column 2."""
    made: list[list[Any]] = [[0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]]
    for name, value in changes.items():
        made[int(name[1])][int(name[2])] = value
    return made


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (rows(m00=NAN), "finite"),
        (rows(m03=INF), "finite"),
        (rows(m03=10**400), "finite"),
        (rows(m22=-2), "mirrors"),
        (rows(m22=2.01), "stretched"),
        (rows(m02=0.01), "sheared"),
        (rows(m33=2), "last row"),
        (rows(m30=1e-3), "last row"),
        ([[0, 0, 0, 1], [0, 0, 0, 2], [0, 0, 0, 3], [0, 0, 0, 1]], "scale vanishes"),
        (rows(m00="0"), "four rows"),
        (rows(m00=True), "four rows"),
        (rows(m00=None), "four rows"),
        (rows()[:3], "four rows"),
        ([row[:3] for row in rows()], "four rows"),
        ("abcd", "four rows"),
        (["abcd"] * 4, "four rows"),
        ({"matrix": rows()}, "four rows"),
        (7, "four rows"),
    ],
)
def test_what_is_no_similarity(value: Any, said: str) -> None:
    fault = similarity_fault(value)
    assert fault is not None
    assert said in fault


def test_exact_transforms_pass_in_the_spelling_of_documents() -> None:
    for seed in range(20):
        T = Sim3.exp(torch.randn(7, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
        assert similarity_fault(json.loads(json.dumps(T.matrix().tolist()))) is None


def test_the_engine_takes_whatever_passes() -> None:
    generator = torch.Generator().manual_seed(0)
    passed = refused = 0
    for _ in range(150):
        T = Sim3.exp(torch.randn(7, generator=generator, dtype=torch.float64))
        matrix = T.matrix()
        noise = torch.randn(3, 3, generator=generator, dtype=torch.float64)
        matrix[:3, :3] += 0.4 * TOLERANCE * T.scale * torch.rand((), generator=generator, dtype=torch.float64) * noise
        if similarity_fault(matrix.tolist()) is None:
            passed += 1
            Sim3.from_matrix(matrix)
        else:
            refused += 1
    assert min(passed, refused) > 20  # the line runs through the cases


def test_what_the_engine_refuses_does_not_pass() -> None:
    sheared = torch.eye(4, dtype=torch.float64)
    sheared[0, 1] = 2 * TOLERANCE
    with pytest.raises(InvalidInputError):
        Sim3.from_matrix(sheared)
    assert similarity_fault(sheared.tolist()) is not None
