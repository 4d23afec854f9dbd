"""Lists as CommonMark has them, written as Python-Markdown wants them: a blank line before, four spaces a level."""

from __future__ import annotations

import re

_ITEM = re.compile(r"( *)([-*+]|\d+[.)])( +)(?=\S)")
_LEVEL = 4


def with_plain_lists(text: str) -> str:
    lines: list[str] = []
    offsets: list[int] = []  # where the text of each list item that is open begins
    fence_shift: int | None = None
    for line in text.split("\n"):
        bare = line.lstrip(" ")
        indent = len(line) - len(bare)
        if fence_shift is not None:
            lines.append(" " * max(indent + fence_shift, 0) + bare if bare else "")
            fence_shift = None if bare.startswith("```") else fence_shift
            continue
        item = _ITEM.match(line)
        if not bare or (offsets and indent < offsets[-1] and not item and lines[-1].strip()):
            lines.append(line)  # a blank line, or a paragraph that goes on without its indentation
            continue
        while offsets and indent < offsets[-1]:
            offsets.pop()
        if item and not offsets and lines and lines[-1].strip() and not _ITEM.match(lines[-1]):
            if _begins_in_a_sentence(item):
                lines.append(line)
                continue
            lines.append("")
        moved = _LEVEL * len(offsets) + indent - (offsets[-1] if offsets else 0)
        lines.append(" " * moved + bare)
        if item:
            offsets.append(item.end())
        if bare.startswith("```"):
            fence_shift = moved - indent
    return "\n".join(lines)


def _begins_in_a_sentence(item: re.Match[str]) -> bool:
    """A line of a paragraph that happens to begin with a number other than 1 is no list (CommonMark)."""
    return item[2][0].isdigit() and item[2][:-1] != "1"
