"""One request of an upload in pieces: the piece is read and kept, and the field made once all are here."""

from __future__ import annotations

from dataclasses import dataclass

from starlette.requests import Request

from regnf_service.concurrency import in_thread
from regnf_service.fields.ingest import StoredUpload, check_room
from regnf_service.fields.piecewise import PieceRange, arrived, check_piece, finish_pieces, held, keep_piece, open_piece
from regnf_service.http import body
from regnf_service.http.pace import Pace
from regnf_service.problem import Problem
from regnf_service.services import Services


@dataclass(frozen=True)
class Piece:
    """One piece of a caller's upload. digest: of the piece, where it was announced · complete: whether the last piece
    makes the field."""

    caller: str
    sha256: str
    range: PieceRange
    digest: str | None
    complete: bool


async def receive_piece(request: Request, services: Services, piece: Piece, pace: Pace) -> StoredUpload | int:
    """The field, once all pieces are here; before that how many bytes have arrived.

    Raises Problem: what ``check_room``, ``check_piece``, ``keep_piece`` and ``finish_pieces`` raise, DIGEST_MISMATCH.
    """
    room = await in_thread(check_room, services, piece.caller, piece.sha256)
    known = await held(services, piece.caller, piece.sha256)
    if known is None:
        await check_piece(services, piece.caller, piece.sha256, piece.range)
    await _receive(request, services, piece, room, pace, keep=known is None)
    if known is not None:
        return known
    offset = await arrived(services, piece.caller, piece.sha256)
    if piece.complete and offset == piece.range.total:
        return await finish_pieces(services, piece.caller, piece.sha256)
    return offset


async def _receive(
    request: Request, services: Services, piece: Piece, room: int | None, pace: Pace, keep: bool
) -> None:
    """Read the body to its end, and keep it if it is a piece that is wanted."""
    body.refuse_encoding(request)
    data = body.chunks(request, piece.range.length, pace, too_large="INVALID_HEADER")  # more than Content-Range says
    if piece.range.first is None:
        async for _ in data:
            pass
        return
    with services.under_way.claim(piece.caller, room, piece.range.length) as claim:
        async with open_piece(services, claim, piece.range) as upload:
            async for block in data:
                await upload.feed(block)
            received = await upload.finish()
            if piece.digest not in (None, received.sha256):
                raise Problem("DIGEST_MISMATCH")
            if keep:
                await keep_piece(services, piece.caller, piece.sha256, piece.range, upload, received)
