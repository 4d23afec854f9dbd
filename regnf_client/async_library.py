"""The library of the awaited client: ``client.library``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import regnf_client.library as library
from regnf_client.async_driver import AsyncDriver
from regnf_client.connection import Connection
from regnf_client.fields import FieldLike, Report
from regnf_client.models import Entry
from regnf_core.library_entries import EntryNotes


class AsyncLibrary:
    """Objects by name. An ``Entry`` may be given wherever a field may."""

    def __init__(self, connection: Connection, driver: AsyncDriver) -> None:
        self._connection = connection
        self._driver = driver

    async def add(
        self,
        name: str,
        field: FieldLike,
        tags: Sequence[str] = (),
        unit: str | None = None,
        note: str | None = None,
        symmetry: dict[str, Any] | None = None,
        progress: Report | None = None,
    ) -> Entry:
        """Make a field an entry; a file is uploaded. symmetry: order, axis, continuous; None: the detected one.

        Raises ServiceError (LIBRARY_NAME_TAKEN, FIELD_IN_LIBRARY), InvalidInputError (LIBRARY_ENTRY_INVALID).
        """
        notes = EntryNotes.checked(name, tags, unit, note, symmetry)
        return await self._driver.run(library.add(self._connection.asking(progress), field, notes))

    async def entries(self, tag: str | None = None, name: str | None = None) -> list[Entry]:
        """Those with the tag, and with ``name`` in their names; the one added last first."""
        return await self._driver.run(library.entries(self._connection.asking(), tag, name))

    async def get(self, name: str) -> Entry:
        """Raises ServiceError (LIBRARY_ENTRY_NOT_FOUND)."""
        return await self._driver.run(library.get(self._connection.asking(), name))

    async def change(self, name: str, /, **changes: Any) -> Entry:
        """Change name, tags, unit, note or symmetry; None takes one back. Raises ServiceError (LIBRARY_NAME_TAKEN)."""
        return await self._driver.run(library.change(self._connection.asking(), name, changes))

    async def remove(self, name: str) -> None:
        """Take an entry out; its field stays. Raises ServiceError (LIBRARY_ENTRY_NOT_FOUND)."""
        await self._driver.run(library.remove(self._connection.asking(), name))

    async def download(self, name: str, target: str | Path) -> Path:
        """Write an entry's field, in the safe format."""
        return await self._driver.run(library.download(self._connection.asking(), name, Path(target)))
