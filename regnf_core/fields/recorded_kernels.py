"""Evaluation on a GPU by recorded kernels: a network is some hundred small kernels, and to launch them one by one takes
longer than they do.

A CUDA graph has fixed addresses and shapes. So there is one for each size of points, a power of two; fewer points are
padded.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Lock

import torch
from torch import Tensor

LEAST, MOST = 1 << 10, 1 << 16
"""Points of the smallest and of the largest graph: each keeps the memory of its layers."""
_USES = 3
"""So often a size is requested before it is recorded: to record takes as long as some evaluations."""
_log = logging.getLogger(__name__)

Evaluation = Callable[[Tensor], tuple[Tensor, Tensor]]
Recorder = Callable[[Evaluation, Tensor], "tuple[Callable[[], None], tuple[Tensor, Tensor]]"]
"""Of an evaluation and its points: what runs it once more, and where its results are then."""


def record_cuda(evaluate: Evaluation, points: Tensor) -> tuple[Callable[[], None], tuple[Tensor, Tensor]]:
    """The evaluation as a CUDA graph. Raises RuntimeError where something in it cannot be recorded."""
    aside = torch.cuda.Stream(points.device)  # type: ignore[no-untyped-call]
    aside.wait_stream(torch.cuda.current_stream(points.device))
    with torch.cuda.stream(aside):
        evaluate(points)  # libraries prepare themselves in a first call
    torch.cuda.current_stream(points.device).wait_stream(aside)
    graph = torch.cuda.CUDAGraph()
    # On the points' device, whichever is the current one; other threads may go on with theirs.
    with torch.cuda.device(points.device), torch.cuda.graph(graph, capture_error_mode="thread_local"):
        found = evaluate(points)
    return graph.replay, found


@dataclass
class RecordedEvaluation:
    """``evaluate``, which gives distance (N,) and gradient (N, 3) at points (N, 3) by the same kernels each time."""

    evaluate: Evaluation
    record: Recorder = record_cuda
    _uses: dict[int, int] = field(default_factory=dict)
    _recorded: dict[int, tuple[Tensor, Callable[[], None], tuple[Tensor, Tensor]]] = field(default_factory=dict)
    _lock: Lock = field(default_factory=Lock)

    def __call__(self, points: Tensor) -> tuple[Tensor, Tensor]:
        count = len(points)
        size = max(LEAST, 1 << (count - 1).bit_length())
        if not 0 < count <= MOST:
            return self.evaluate(points)
        with self._lock:  # the graph's points and results are the same memory for all
            uses = self._uses[size] = self._uses.get(size, 0) + 1
            if uses == _USES:
                self._try_to_record(size, points)
            if size not in self._recorded:
                return self.evaluate(points)
            given, run, (distance, gradient) = self._recorded[size]
            given[:count].copy_(points)
            run()
            return distance[:count].clone(), gradient[:count].clone()

    def _try_to_record(self, size: int, points: Tensor) -> None:
        given = points.new_zeros(size, 3)
        try:
            self._recorded[size] = (given, *self.record(self.evaluate, given))
        except RuntimeError as error:
            _log.warning("kernels of a field cannot be recorded, they are launched one by one: %s", error)
