"""The tests' own rendering of compose files keeps to the Compose Specification."""

from __future__ import annotations

from pathlib import Path

import pytest

from scripts.images.commands import documented_commands
from scripts.images.compose import render
from scripts.images.interpolation import ComposeError, interpolate

VARIABLES = {"SET": "value", "EMPTY": "", "OTHER": "other"}


REPLACED = {
    "plain": "plain", "$SET and ${SET}": "value and value", "${UNSET}$UNSET": "", "$SET.x": "value.x",
    "$$SET $${SET}": "$SET ${SET}", "${UNSET:-[]}": "[]",
    "${SET:-default} ${EMPTY:-default} ${UNSET:-default}": "value default default",
    "${SET-default}|${EMPTY-default}|${UNSET-default}": "value||default",
    "${SET:+there}|${EMPTY:+there}|${UNSET:+there}": "there||",
    "${SET+there}|${EMPTY+there}|${UNSET+there}": "there|there|",
    "${SET:?missing} ${EMPTY?missing}!": "value !", "${UNSET:-${OTHER}}:80": "other:80",
    "${UNSET:-${EMPTY:-127.0.0.1:8080}}:8080": "127.0.0.1:8080:8080",
}  # fmt: skip
REFUSED = {
    "${UNSET:?set it}": "required variable UNSET is missing a value: set it",
    "${EMPTY:?set $OTHER}": "required variable EMPTY is missing a value: set other",
    "${UNSET?set it}": "required variable UNSET is missing a value: set it",
    "$": "a dollar sign is written", "a $ b": "a dollar sign is written", "${SET": "a brace is not closed",
    "${}": "invalid interpolation format", "${1SET}": "invalid interpolation format",
    "${SET!x}": "invalid interpolation format",
}  # fmt: skip


def test_variables_are_replaced_and_refused_as_compose_does() -> None:
    assert {text: interpolate(text, VARIABLES) for text in REPLACED} == REPLACED
    for text, said in REFUSED.items():
        with pytest.raises(ComposeError) as caught:
            interpolate(text, VARIABLES)
        assert said in str(caught.value)


def test_a_service_that_is_not_started_is_interpolated_all_the_same(tmp_path: Path) -> None:
    """As compose does: a variable that only an inactive profile needs stops every command."""
    path = tmp_path / "compose.yaml"
    path.write_text(
        "services:\n"
        "  always: {image: a}\n"
        "  sometimes: {image: b, profiles: [extra], environment: {PASSWORD: '${PASSWORD:?set it}'}}\n"
    )
    with pytest.raises(ComposeError, match="PASSWORD"):
        render(path, {})
    assert list(render(path, {"PASSWORD": "x"})) == ["always"]
    assert render(path, {"PASSWORD": "x"}, ["extra"])["sometimes"]["environment"] == {"PASSWORD": "x"}
    assert list(render(path, {"PASSWORD": "x", "COMPOSE_PROFILES": "extra"})) == ["always", "sometimes"]


def test_finds_commands_with_what_is_set_for_them(tmp_path: Path) -> None:
    (tmp_path / "docs").mkdir()
    (tmp_path / "docker").mkdir()
    (tmp_path / "README.md").write_text("Call `docker compose -f a.yaml up`.\n")
    (tmp_path / "docs/page.md").write_text(
        "It's prose.\n```\nexport A='one two' B=2\nC=3 docker compose -f a.yaml --profile p \\\n  up --scale w=4\n```\n"
    )
    (tmp_path / "docker/compose.yaml").write_text("# Call it:\n#   D=4 docker compose -f a.yaml up --wait\n")
    found = [(command.source, command.variables, command.profiles) for command in documented_commands(tmp_path)]
    assert found == [
        ("README.md", {}, ()),
        ("docs/page.md", {"A": "one two", "B": "2", "C": "3"}, ("p",)),
        ("docker/compose.yaml", {"D": "4"}, ()),
    ]


def test_a_command_that_compose_does_not_know_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "docker").mkdir()
    for command in ("docker compose -f a.yaml up --wiat", "docker compose -f a.yaml pu", "sh docker compose "):
        (tmp_path / "README.md").write_text(f"```\n{command}\n```\n")
        with pytest.raises(ComposeError):
            documented_commands(tmp_path)
