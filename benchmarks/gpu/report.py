"""The report: sections with tables, and bars that are met or not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Section:
    """A title, a table, and what else is to be said. met: False where a result is not the CPU's."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()
    met: bool = True

    def text(self) -> str:
        """As Markdown."""
        lines = [f"## {self.title}", "", _row(self.head), "|---" * len(self.head) + "|"]
        lines += [_row(row) for row in self.rows]
        for note in self.notes:
            lines += ["", note]
        return "\n".join(lines)


@dataclass
class Report:
    """Sections below a heading."""

    heading: str
    sections: list[Section] = field(default_factory=list)

    def add(self, section: Section) -> None:
        """One more section."""
        self.sections.append(section)

    @property
    def met(self) -> bool:
        """Whether all results are the CPU's."""
        return all(section.met for section in self.sections)

    def text(self) -> str:
        """As Markdown."""
        return "\n\n".join([self.heading, *(section.text() for section in self.sections)])


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
