"""Options at the ends of their ranges: each alone, in pairs, and all together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from itertools import combinations
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from annotated_types import Ge, Gt, Le

from regnf_core.options import Preset, RegistrationOptions

_ABOVE = 1e-3
"""What stands for the lower end of a range that the end itself is not part of."""


@dataclass(frozen=True)
class NumericOption:
    """An option with a range. name: its group, and its own name."""

    name: tuple[str, str]
    lowest: float
    highest: float

    def ends(self) -> Iterator[tuple[tuple[str, str], float]]:
        yield self.name, self.lowest
        yield self.name, self.highest


def numeric_options() -> list[NumericOption]:
    """Every option with a range, by the schema itself."""
    found = []
    for group in fields(RegistrationOptions):
        if not callable(group.default_factory):
            continue
        for name, hint in get_type_hints(type(group.default_factory()), include_extras=True).items():
            if get_origin(hint) is Annotated:
                kind, *bounds = get_args(hint)
                found.append(NumericOption((group.name, name), _lowest(kind, bounds), _highest(bounds)))
    return found


def extremes(preset: Preset) -> Iterator[tuple[str, dict[str, Any]]]:
    """What is at an end, in words, and the options as plain values."""
    options = [one for one in numeric_options() if (one.name[0] == "robust") == (preset == "robust")]
    for one in options:
        for end in one.ends():
            yield _entry(preset, [end])
    for first, second in combinations(options, 2):
        for end in first.ends():
            for other in second.ends():
                yield _entry(preset, [end, other])
    yield "all at their lowest", _entry(preset, [(one.name, one.lowest) for one in options])[1]
    yield "all at their highest", _entry(preset, [(one.name, one.highest) for one in options])[1]


def _entry(preset: Preset, ends: list[tuple[tuple[str, str], float]]) -> tuple[str, dict[str, Any]]:
    values: dict[str, Any] = {"preset": preset}
    for (group, name), value in ends:
        values.setdefault(group, {})[name] = value
    return ", ".join(f"{group}.{name}={value:g}" for (group, name), value in ends), values


def _lowest(kind: type, bounds: list[Any]) -> float:
    for bound in bounds:
        if isinstance(bound, Ge):
            return kind(bound.ge)  # type: ignore[no-any-return]
        if isinstance(bound, Gt):
            return float(bound.gt) + _ABOVE  # type: ignore[arg-type]
    raise AssertionError("an option without a lower end")


def _highest(bounds: list[Any]) -> float:
    return next(one.le for one in bounds if isinstance(one, Le))
