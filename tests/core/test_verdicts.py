"""Every reason that an engine can give for its verdict is told in words."""

from __future__ import annotations

import re
from pathlib import Path

from regnf_core.errors import VERDICT_REASONS

CORE = Path(__file__).resolve().parents[2] / "regnf_core"


def test_the_table_holds_the_reasons_of_both_presets_and_no_others() -> None:
    given: set[str] = set()
    for source in (CORE / "paper" / "pipeline.py", *sorted((CORE / "robust" / "verdict").glob("*.py"))):
        text = source.read_text(encoding="utf-8")
        given |= set(re.findall(r'(?:"(?:registered|ambiguous|rejected)", |return |_Limit\()"([A-Z_]+)"', text))
    assert given == set(VERDICT_REASONS)
