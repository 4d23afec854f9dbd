"""XML as a plain tree: elements, attributes, text. No document type, so no entities; nothing outside is ever opened."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any
from xml.parsers import expat

from regnf_core.importing.meshes.geometry import malformed

_MAX_DEPTH, _MAX_ELEMENTS = 256, 500_000


@dataclass(eq=False)
class Element:
    """``name`` is without its namespace; ``text`` is what stands directly within."""

    name: str
    attributes: dict[str, str]
    children: list[Element] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)

    @property
    def text(self) -> str:
        return "".join(self.texts)

    def all(self, *names: str) -> Iterator[Element]:
        """The children of these names, in their order."""
        return (child for child in self.children if child.name in names)

    def first(self, *path: str) -> Element | None:
        """The first element down this path of names."""
        here: Element | None = self
        for name in path:
            here = next(here.all(name), None) if here is not None else None
        return here


class _Builder:
    def __init__(self) -> None:
        self.root = Element("", {})
        self._open = [self.root]
        self._elements = 0

    def start(self, name: str, attributes: dict[str, str]) -> None:
        self._elements += 1
        if len(self._open) > _MAX_DEPTH or self._elements > _MAX_ELEMENTS:
            raise malformed("the XML file nests too deep, or has too many elements")
        element = Element(name.rpartition(":")[2], attributes)
        self._open[-1].children.append(element)
        self._open.append(element)

    def end(self, _name: str) -> None:
        self._open.pop()

    def text(self, text: str) -> None:
        self._open[-1].texts.append(text)


def read_xml(data: memoryview) -> Element:
    """An element that holds the document's. Raises FieldFormatError (MESH_INVALID)."""
    builder = _Builder()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.text
    parser.StartDoctypeDeclHandler = _refuse
    parser.EntityDeclHandler = _refuse
    parser.ExternalEntityRefHandler = _refuse
    try:
        parser.Parse(bytes(data), True)
    except expat.ExpatError as error:
        raise malformed(f"the XML file is malformed: {expat.ErrorString(error.code)}") from error
    except (LookupError, ValueError) as error:  # an encoding that expat asks Python for
        raise malformed("the XML file has an encoding that is not known") from error
    return builder.root


def _refuse(*_: object) -> Any:
    raise malformed("the XML file declares a document type or entities, which no mesh needs")
