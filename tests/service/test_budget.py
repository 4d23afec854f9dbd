"""How long a caller waits whose work of the last hour has used up the budget."""

from __future__ import annotations

import pytest

from regnf_service.library import seconds_until_free

NOW = 100 * 60.0


@pytest.mark.parametrize(
    ("spent", "wait_s"),
    [
        ({}, 0), ({99: 59.9}, 0), ({99: 60.0}, 59 * 60), ({41: 30.0, 99: 59.0}, 60),
        ({41: 0.5, 50: 1.0, 99: 59.0}, 10 * 60), ({99: 6000.0}, 59 * 60), ({40: 1.0, 99: 59.5}, 1),
    ],
)  # fmt: skip
def test_until_enough_is_an_hour_ago(spent: dict[int, float], wait_s: int) -> None:
    assert seconds_until_free(spent, 60, NOW) == wait_s
