"""Tiles of a frame side by side, in as many threads as torch may use."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch
from torch import Tensor

_Seen = TypeVar("_Seen")


def tiles_at_once(device: torch.device) -> int:
    """How many tiles are worked on at a time. torch itself spreads only large operations over threads; those of a tile
    are small."""
    return torch.get_num_threads() if device.type == "cpu" else 1


def in_turn(
    look: Callable[[Tensor], _Seen], tiles: Sequence[Tensor], device: torch.device, before: Callable[[], None]
) -> Iterator[tuple[Tensor, _Seen]]:
    """Each tile and what ``look`` finds there, in their order.

    before: called in this thread before each tile; what it or ``look`` raises ends the work once the tiles that are
    being looked at are done.
    """
    count = tiles_at_once(device)
    if count == 1:
        for tile in tiles:
            before()
            yield tile, look(tile)
        return
    waiting: deque[tuple[Tensor, Future[_Seen]]] = deque()
    with ThreadPoolExecutor(count) as pool:
        try:
            for tile in tiles:
                before()
                waiting.append((tile, pool.submit(look, tile)))
                if len(waiting) > count:  # one more than are worked on, so that no thread waits
                    done, seen = waiting.popleft()
                    yield done, seen.result()
            while waiting:
                done, seen = waiting.popleft()
                yield done, seen.result()
        finally:
            for _, seen in waiting:
                seen.cancel()
