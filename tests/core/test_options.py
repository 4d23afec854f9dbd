"""Options: what is refused, and what the refusal suggests."""

from __future__ import annotations

from typing import Any

import pytest

from regnf_core.errors import InvalidOptionsError
from regnf_core.options import RegistrationOptions


@pytest.mark.parametrize(
    ("values", "meant"),
    [
        ({"robust": {"up_axis": "z"}}, "up_axis"),
        ({"sampling": {"up_axis": "y"}}, "up_axis"),
        ({"initialisation": {"draws": 3}}, "initialization"),
        ({"optimization": {"regulariser_weight": 0.5}}, "optimization.regularizer_weight"),
        ({"robust": {"max_hidden_share": 0.5}}, "robust.max_occluded_share"),
        ({"robust": {"rotation": 300}}, "robust.rotations"),
        ({"rotations": 300}, "robust.rotations"),
        ({"upaxis": "z"}, "up_axis"),
    ],
)
def test_an_unknown_option_is_refused_with_the_name_that_was_meant(values: dict[str, Any], meant: str) -> None:
    with pytest.raises(InvalidOptionsError, match=f"did you mean `{meant}`\\?"):
        RegistrationOptions.from_dict(values)


def test_a_name_like_none_gets_no_suggestion() -> None:
    with pytest.raises(InvalidOptionsError) as raised:
        RegistrationOptions.from_dict({"qqqqqq": 1})
    assert "did you mean" not in str(raised.value)
    assert str(raised.value).startswith("options.qqqqqq: ")


def test_there_is_one_up_axis() -> None:
    given = RegistrationOptions.from_dict({"up_axis": "y"}).to_dict()
    assert given["up_axis"] == "y"
    assert [name for name, group in given.items() if isinstance(group, dict) and "up_axis" in group] == []
