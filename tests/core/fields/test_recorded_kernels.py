"""Recorded evaluation: sizes, padding, and what happens where nothing can be recorded.

The recorder is one of the CPU: it runs the evaluation again at the same memory, as a graph does.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from regnf_core.fields.recorded_kernels import LEAST, MOST, RecordedEvaluation


def evaluate(points: Tensor) -> tuple[Tensor, Tensor]:
    return points.square().sum(-1), 2.0 * points


class Recorder:
    """Its graphs write where the results of the recording are."""

    def __init__(self) -> None:
        self.sizes: list[int] = []
        self.runs = 0

    def __call__(
        self, evaluation: Callable[[Tensor], tuple[Tensor, Tensor]], points: Tensor
    ) -> tuple[Callable[[], None], tuple[Tensor, Tensor]]:
        self.sizes.append(len(points))
        results = evaluation(points)

        def run() -> None:
            self.runs += 1
            for kept, one in zip(results, evaluation(points), strict=True):
                kept.copy_(one)

        return run, results


def test_each_size_is_recorded_once_and_gives_what_the_evaluation_gives() -> None:
    recorder = Recorder()
    recorded = RecordedEvaluation(evaluate, recorder)
    numbers = torch.Generator().manual_seed(0)
    earlier = []
    for count in (5, 700, LEAST, LEAST, 3, LEAST + 1, 2 * LEAST, 2 * LEAST - 7, MOST, 2):
        points = torch.randn(count, 3, generator=numbers)
        earlier.append((points, recorded(points)))
    assert recorder.sizes == [LEAST, 2 * LEAST]
    assert recorder.runs == 3 + 1 + 1
    for points, (distance, gradient) in earlier:  # no result lies where the next one was written
        torch.testing.assert_close(distance, points.square().sum(-1))
        torch.testing.assert_close(gradient, 2.0 * points)


def test_none_and_too_many_points_are_not_recorded() -> None:
    recorder = Recorder()
    recorded = RecordedEvaluation(evaluate, recorder)
    for _ in range(5):
        assert recorded(torch.zeros(0, 3))[0].shape == (0,)
        assert recorded(torch.zeros(MOST + 1, 3))[0].shape == (MOST + 1,)
    assert recorder.sizes == []


def test_what_cannot_be_recorded_is_evaluated(caplog: pytest.LogCaptureFixture) -> None:
    def unable(evaluation: object, points: Tensor) -> tuple[Callable[[], None], tuple[Tensor, Tensor]]:
        raise RuntimeError("operation not permitted when stream is capturing")

    recorded = RecordedEvaluation(evaluate, unable)
    for _ in range(6):
        points = torch.rand(9, 3)
        torch.testing.assert_close(recorded(points)[0], points.square().sum(-1))
    assert caplog.text.count("cannot be recorded") == 1
