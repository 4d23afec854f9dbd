"""An upload in pieces: each is stored on its own, and the last one makes the field, as if all had come at once."""

from __future__ import annotations

from dataclasses import dataclass

from regnf_core.importing.containers.sniff import HEAD_BYTES, RECORDINGS
from regnf_service.concurrency import Claim, in_thread
from regnf_service.fields.ingest import Beside, StoredUpload, check_room, held_field, keep_held, store_upload
from regnf_service.fields.uploads import Upload
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.pieces import MOST_PIECES


@dataclass(frozen=True)
class PieceRange:
    """Bytes ``first`` to ``end`` - 1 of a file of ``total`` bytes. Both None: no bytes, `bytes */total`."""

    first: int | None
    end: int | None
    total: int

    @property
    def length(self) -> int:
        """How many bytes the body must have."""
        return 0 if self.first is None or self.end is None else self.end - self.first


class PieceUpload(Upload):
    """One piece. Only the file's beginning shows whether it can be a field."""

    def __init__(self, services: Services, claim: Claim, piece: PieceRange) -> None:
        super().__init__(services, claim, piece.length)
        self._recognized = piece.first != 0 or piece.length < HEAD_BYTES

    def _recognize(self) -> None:
        if self._pending.startswith(RECORDINGS):
            self._recognized = True
        else:
            super()._recognize()


def check_piece(services: Services, caller: str, sha256: str, piece: PieceRange) -> None:
    """Refuse a piece before it comes. Blocking. Raises Problem UPLOAD_NOT_FINISHED, INVALID_HEADER, TOO_MANY_PIECES."""
    found = services.pieces.find(caller, sha256)
    if piece.first is None:
        return
    if piece.first != found.offset:
        raise _not_finished(found.offset)
    if found.total not in (0, piece.total):
        raise Problem("INVALID_HEADER", f"The earlier pieces belong to a file of {found.total} bytes.")
    if found.pieces >= MOST_PIECES:
        raise Problem("TOO_MANY_PIECES", f"At most {MOST_PIECES} pieces are allowed.")


async def finish_pieces(
    services: Services, caller: str, sha256: str, beside: Beside | None = None, kind: type[Upload] = Upload
) -> StoredUpload:
    """Make the field of the pieces, which then go; of another ``kind`` of upload the recording.

    The pieces are read only when all are here and the field has room, one upload of a caller after the other: until the
    field is recorded there are two copies of the bytes. Raises Problem UPLOAD_NOT_FINISHED, DIGEST_MISMATCH (the pieces
    go), and what ``check_room`` and ``store_upload`` raise.
    """
    async with services.assembling.turn(caller):
        known = await in_thread(held_field, services, caller, sha256)
        if known is not None:
            taken = await in_thread(keep_held, services, known, beside or Beside())
        else:
            taken = await _assembled(services, caller, sha256, beside, kind)
    await in_thread(services.pieces.drop, caller, sha256)
    return taken


async def _assembled(
    services: Services, caller: str, sha256: str, beside: Beside | None, kind: type[Upload]
) -> StoredUpload:
    found = await in_thread(services.pieces.find, caller, sha256)
    if not found.total or found.offset != found.total:
        raise _not_finished(found.offset)
    room = await in_thread(check_room, services, caller, sha256)
    if room is not None:
        room += found.bytes  # the field takes their place
    with services.under_way.claim(caller, room, found.total) as claim:
        async with kind(services, claim) as upload:
            blocks = services.pieces.blocks(caller, sha256)
            try:
                while (block := await in_thread(next, blocks, b"")) != b"":
                    await upload.feed(block)
            except FileNotFoundError as error:  # they were deleted in between
                raise _not_finished(0) from error
            received = await upload.finish()
            if received.sha256 != sha256:
                await in_thread(services.pieces.drop, caller, sha256)
                raise Problem("DIGEST_MISMATCH")
            return await store_upload(services, caller, upload, received, beside)


def _not_finished(offset: int) -> Problem:
    return Problem("UPLOAD_NOT_FINISHED", extra={"offset": offset}, headers={"Upload-Offset": str(offset)})
