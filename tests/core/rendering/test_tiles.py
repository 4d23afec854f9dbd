"""Tiles of a frame side by side: in order, ended by what goes wrong, and the same as one after the other."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from regnf_core.errors import CancelledError
from regnf_core.rendering.tiles import in_turn, tiles_at_once

CPU = torch.device("cpu")
TILES = [torch.tensor([number]) for number in range(7)]


@pytest.fixture(params=[1, 3])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_tiles_come_in_their_order(threads: int) -> None:
    asked: list[int] = []
    seen = in_turn(lambda tile: 10 * int(tile), TILES, CPU, lambda: asked.append(1))
    assert [(int(tile), value) for tile, value in seen] == [(number, 10 * number) for number in range(7)]
    assert len(asked) == 7


@pytest.mark.parametrize("threads", [3], indirect=True)
def test_as_many_at_a_time_as_torch_may_use(threads: int) -> None:
    """Each waits for the others: one after the other they would wait for ever."""
    together = threading.Barrier(threads, timeout=60)
    tiles = TILES[: 2 * threads]
    assert len(list(in_turn(lambda _: together.wait(), tiles, CPU, lambda: None))) == len(tiles)
    assert tiles_at_once(CPU) == threads
    assert tiles_at_once(torch.device("cuda")) == 1


def test_what_goes_wrong_in_a_tile_ends_the_work(threads: int) -> None:
    looked: list[int] = []

    def look(tile: Tensor) -> None:
        looked.append(int(tile))
        if int(tile) == 1:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        list(in_turn(look, TILES, CPU, lambda: None))
    assert len(looked) < len(TILES)


def test_cancelling_ends_the_work(threads: int) -> None:
    left = [1, 1, 0]

    def before() -> None:
        if not left.pop(0):
            raise CancelledError("enough")

    looked: list[int] = []
    with pytest.raises(CancelledError):
        list(in_turn(lambda tile: looked.append(int(tile)), TILES, CPU, before))
    assert sorted(looked) in ([0, 1], [0], [])
