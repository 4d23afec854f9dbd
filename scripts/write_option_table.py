"""Write the table of the options that the preset `robust` uses into docs/api.md. A test compares the two.

python scripts/write_option_table.py
"""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from regnf_core.options import RegistrationOptions, RobustOptions

TARGET = Path(__file__).resolve().parents[1] / "docs" / "api.md"
_PLACE = re.compile(r"(<!-- made by scripts/write_option_table.py [^\n]*-->\n).*?(<!-- end -->)", flags=re.S)


def with_table(text: str) -> str:
    """The document with the table as the options are now."""
    schema = TypeAdapter(RobustOptions).json_schema()["properties"]
    common = TypeAdapter(RegistrationOptions).json_schema()["properties"]
    rows = [_row("up_axis", common["up_axis"])]
    rows += [_row(f"robust.{option.name}", schema[option.name]) for option in dataclasses.fields(RobustOptions)]
    table = "\n".join(["| Option | Default | Range | |", "|---|---|---|---|", *rows])
    return _PLACE.sub(lambda found: f"{found[1]}{table}\n{found[2]}", text)


def _row(name: str, option: dict[str, Any]) -> str:
    meaning = " ".join(option["description"].split()).replace("|", "\\|")
    return f"| `{name}` | {json.dumps(option['default'])} | {_range(option)} | {meaning} |"


def _range(option: dict[str, Any]) -> str:
    if "anyOf" in option:
        return ", ".join(_range(kind) for kind in option["anyOf"])
    if option.get("type") == "null":
        return "null"
    if "enum" in option:
        return ", ".join(json.dumps(value) for value in option["enum"])
    low = f"{option['minimum']:g} to" if "minimum" in option else f"above {option['exclusiveMinimum']:g}, to"
    return f"{low} {option['maximum']:g}"


if __name__ == "__main__":
    TARGET.write_text(with_table(TARGET.read_text(encoding="utf-8")), encoding="utf-8")
    print(f"wrote the options into {TARGET.name}")
