"""Requests whose options multiply to more memory or time than a job may have."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from redis import Redis

from tests.contract.bad_input import post
from tests.contract.world import World, assert_refused, make_world

COSTLY: list[tuple[dict[str, Any], set[str]]] = [
    (
        {"preset": "paper", "sampling": {"views": 64, "image_size": 4096, "pixel_stride": 1}},
        {"/options/sampling/views", "/options/sampling/image_size", "/options/sampling/pixel_stride"},
    ),
    (
        {"preset": "paper", "initialization": {"draws": 256, "ransac_iterations": 10_000_000}},
        {"/options/initialization/draws", "/options/initialization/ransac_iterations"},
    ),
    (
        {
            "preset": "paper",
            "optimization": {"iterations": 10_000, "samples_per_iteration": 1_000_000},
            "resampling": {"max_samples": 1_000_000, "every": 10_000},
        },
        {"/options/optimization/iterations", "/options/optimization/samples_per_iteration"},
    ),
    (
        {
            "preset": "paper",
            "optimization": {"iterations": 10_000},
            "resampling": {"every": 1, "max_samples": 1_000_000},
        },
        {"/options/optimization/iterations", "/options/resampling/every", "/options/resampling/max_samples"},
    ),
]


@pytest.mark.parametrize(("options", "pointers"), COSTLY, ids=["rays", "draws", "iterations", "resamplings"])
def test_options_whose_product_is_too_costly(world: World, options: dict[str, Any], pointers: set[str]) -> None:
    body = world.valid_request() | {"options": options}
    for path in ("/register", "/register?dry_run=true"):
        answer = world.client.post(path, json=body)
        problem = assert_refused(answer, 422, "OPTIONS_TOO_COSTLY")
        assert {fault["pointer"] for fault in problem["errors"]} == pointers
        assert all("limit" in fault["detail"] for fault in problem["errors"])
    assert world.queue.registrations == []


def test_default_options_are_never_too_costly(redis: Redis, tmp_path: Path) -> None:
    world = make_world(tmp_path, redis, job_timeout_s=1, job_memory_bytes=512 << 20)
    for preset in ("paper", "robust"):
        body = world.valid_request() | {"options": {"preset": preset}}
        assert post(world, body).status_code == 202
    dearer = world.valid_request() | {"options": {"preset": "paper", "optimization": {"iterations": 10_000}}}
    assert_refused(post(world, dearer), 422, "OPTIONS_TOO_COSTLY")


def test_a_product_that_a_fast_field_does_in_time_is_taken(world: World) -> None:
    body = world.valid_request() | {"options": {"preset": "paper", "optimization": {"iterations": 10_000}}}
    assert post(world, body).status_code == 202
