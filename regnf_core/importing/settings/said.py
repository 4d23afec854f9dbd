"""What a trainer's settings say, as it is collected: entries of a description, and the keys they are from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.families.layers import contradiction
from regnf_core.importing.settings.documents import Documents
from regnf_core.importing.settings.facts import Facts
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.upload_description import UploadDescription


@dataclass
class Said:
    """Filled by one trainer's module."""

    trainer: str
    facts: Facts
    documents: Documents
    values: dict[str, Any] = field(default_factory=dict)
    """Entries of an UploadDescription; those of its parts with a dot: ``hash.levels``."""
    used: dict[str, list[str]] = field(default_factory=dict)
    """Of each file the keys that counted, as "key value"."""
    warnings: list[str] = field(default_factory=list)

    def put(self, entry: str, value: Any, keys: Keys, key: str) -> None:
        """``entry`` of the description is ``value``, by ``key`` of the file. None says nothing."""
        if value is not None:
            self.values[entry] = value
            self.note(keys, key)

    def take(self, keys: Keys, read: Callable[[Keys, str], Any], entries: Mapping[str, str]) -> None:
        """Entries of the description by the keys that they are read from."""
        for entry, key in entries.items():
            self.put(entry, read(keys, key), keys, key)

    def choose(self, entry: str, keys: Keys, key: str, values: tuple[Any, Any]) -> None:
        """``entry`` is the first of the values where ``key`` is true, the second where it is false."""
        flag = keys.flag(key)
        self.put(entry, None if flag is None else values[not flag], keys, key)

    def expect(self, keys: Keys, key: str, *known: str) -> None:
        """Refuse any other text at ``key``. Raises FieldFormatError: SETTINGS_MALFORMED, FAMILY_NOT_SUPPORTED."""
        if keys.text(key) not in (None, "", *known):
            self.refuse(keys, key)

    def note(self, keys: Keys, key: str) -> None:
        """``key`` of the file counted. A long value is not repeated."""
        value = keys.find(key)
        text = "..." if isinstance(value, (dict, list)) and len(str(value)) > 40 else str(value)[:40]
        used = self.used.setdefault(keys.file, [])
        if (line := f"{key.rpartition('.')[2]} {text}") not in used:
            used.append(line)

    def agree(self, keys: Keys, key: str, found: int | None) -> None:
        """Raise FieldFormatError (SETTINGS_CONTRADICT_TENSORS) if ``key`` says another whole number than the tensors.

        None on either side says nothing.
        """
        said = None if found is None else keys.whole(key)
        if said is None or found is None:
            return
        if said != found:
            raise contradiction(f"{keys.file}: {keys.at}{key}", said, found)
        self.note(keys, key)

    def about_color(self, translate: Callable[[], None]) -> None:
        """Run ``translate``; what is malformed about a color leaves the color out, with a warning."""
        try:
            translate()
            said = {name.removeprefix("color."): value for name, value in self.values.items() if "color." in name}
            UploadDescription.from_dict({"color": said})
        except FieldFormatError as error:
            for name in [name for name in self.values if name.startswith("color.")]:
                del self.values[name]
            self.values["color.keep"] = False
            self.warnings.append(f"COLOR_LEFT_OUT: {error}")

    def without_color(self, keys: Keys, names: Sequence[str]) -> None:
        """Leave the color out, with a warning, if there are ``names``: settings that make it one that is not known."""
        if names:
            told = ", ".join(f"{name} {str(keys.find(name))[:40]}" for name in names)
            self.values["color.keep"] = False
            self.warnings.append(f"COLOR_LEFT_OUT: {keys.file}: {told} is not supported; only the geometry is imported")

    def refuse(self, keys: Keys, key: str) -> None:
        """Raise FieldFormatError (FAMILY_NOT_SUPPORTED): the value of ``key`` makes another function of the field."""
        message = f"{keys.file}: {keys.at}{key} is {str(keys.find(key))[:60]}, which is not supported"
        raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
