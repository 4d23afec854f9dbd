"""What a rendering costs at most, estimated from its request alone: memory, seconds, and bytes of files. Torch-free.

Upper ends for memory and files. Seconds are of one core and right within a factor of ten: the fields decide.
"""

from __future__ import annotations

from dataclasses import dataclass

from regnf_core.cost import Cost, Option, Term
from regnf_core.rendering.request import RenderRequest

_RAY_S = {"surface": 50e-6, "volume": 200e-6}
_RAY_BYTES = 4000
_PIXEL_BYTES = 100
"""Of the frame that is being rendered: all that is known at a pixel, and its pictures."""
_KEPT_BYTES = 20
"""Of each pixel of an animation, which is written once all frames are there."""
_NODE_BYTES, _NODE_S = 12, 3e-6
"""Of a node of a lattice that a field is evaluated on."""
_EDIT_S = 5.0
_FILE_BYTES = {"color": 3, "depth": 2 + 4, "normal": 3, "animation": 1}
"""Of each pixel: PNG of bytes that nothing compresses; depth also as .npy."""
_MESH_FILE_BYTES = 200
"""Of each cell that the surface passes through."""
_SIZE: tuple[Option, ...] = (("size",),)


@dataclass(frozen=True)
class RenderCost(Cost):
    """The estimated cost of one rendering. file_bytes: of all that it writes."""

    file_bytes: int


def estimate(request: RenderRequest) -> RenderCost:
    """The cost of a request whose extent has been checked."""
    return RenderCost(tuple(_terms(request)), _file_bytes(request))


def _terms(request: RenderRequest) -> list[Term]:
    width, height = request.image_size
    pixels, options = width * height, request.options
    frames = request.frames * (2 if request.before and request.edits else 1)
    tile = min(options.memory_mb * 1_000_000, pixels * _RAY_BYTES)
    rays = request.rendered_pixels
    where = *_SIZE, *_cameras(request), ("options", "antialias")
    terms = [
        Term("rays", rays, where, 0, rays * _RAY_S[options.mode]),
        Term("pixels of a frame", pixels, _SIZE, tile + pixels * _PIXEL_BYTES, 0.0),
        Term("edits", len(request.edits), (("edits",),), 0, len(request.edits) * _EDIT_S),
    ]
    if "animation" in request.outputs:
        kept = frames * pixels
        terms.append(Term("pixels of the animation", kept, (*_SIZE, *_cameras(request)), kept * _KEPT_BYTES, 0.0))
    for output in ("mesh", "field"):
        if output in request.outputs:
            nodes = (getattr(request, f"{output}_resolution") + 1) ** 3
            where_ = ((f"{output}_resolution",),)
            terms.append(Term(f"nodes of the {output}", nodes, where_, nodes * _NODE_BYTES, nodes * _NODE_S))
    return terms


def _cameras(request: RenderRequest) -> tuple[Option, ...]:
    if request.look_at is not None:
        return (("look_at",),)
    return (("poses",),) if request.poses is not None else (("orbit", "frames"),)


def _file_bytes(request: RenderRequest) -> int:
    width, height = request.image_size
    frames = request.frames * (2 if request.before and request.edits else 1)
    total = width * height * frames * sum(_FILE_BYTES.get(output, 0) for output in request.outputs)
    if "mesh" in request.outputs:
        total += 6 * request.mesh_resolution**2 * _MESH_FILE_BYTES
    if "field" in request.outputs:
        total += 4 * (request.field_resolution + 1) ** 3
    return total
