"""``render`` and ``compose`` as users call them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from regnf_core.api.fields import FieldLike, opened
from regnf_core.editing.compose import compose as engine_compose
from regnf_core.editing.edited_scene import EditedScene
from regnf_core.editing.edits import Edit
from regnf_core.errors import InvalidInputError, InvalidOptionsError
from regnf_core.options import seed_of
from regnf_core.rendering.camera import Camera
from regnf_core.rendering.frame import Frame
from regnf_core.rendering.options import RenderOptions
from regnf_core.rendering.render import render as engine_render

RenderOptionsLike = RenderOptions | Mapping[str, Any] | None


def render(
    field: FieldLike,
    camera: Camera,
    options: RenderOptionsLike = None,
    progress: Callable[[float], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> Frame:
    """One frame of a field, or of the field at a path: color or shading, depth, normals, opacity.

    options: RenderOptions, or a dictionary of those that are not to have their defaults. ``cancelled`` is asked before
    each tile; CancelledError is raised once it says so.
    Raises InvalidInputError: NO_FIELD, CAMERA_IN_MATTER, RENDER_TOO_LARGE, FIELD_NOT_FINITE, COLORS_MISSING; and
    NoSurfaceError (NO_SURFACE_IN_SCENE).
    """
    chosen = _render_options(options)
    return engine_render(opened(field).field, camera, chosen, progress, cancelled)


def compose(
    scene: FieldLike, edits: Sequence[Edit], seed: int = 0, progress: Callable[[float], None] | None = None
) -> EditedScene:
    """The scene, or that at a path, with all edits done: a field as any other. See docs/editing.md.

    Raises InvalidInputError: NO_FIELD, INVALID_TRANSFORM, EDIT_INVALID, EDITS_OVERLAP, EDIT_OUTSIDE_SCENE; and
    NoSurfaceError (NO_SURFACE_IN_OBJECT).
    """
    if not isinstance(edits, Sequence):
        hint = "Write a list: [Removal(box)]."
        raise InvalidInputError("edits must be a list", reason="EDIT_INVALID", hint=hint)
    return engine_compose(opened(scene, "scene").field, edits, seed_of(seed), progress)


def _render_options(options: RenderOptionsLike) -> RenderOptions:
    if options is None or isinstance(options, RenderOptions):
        return options or RenderOptions()
    if isinstance(options, Mapping):
        return RenderOptions.from_dict(dict(options))
    hint = 'Write {"mode": "surface"} or RenderOptions(mode="surface").'
    raise InvalidOptionsError(f"options is a {type(options).__name__}, expected a dictionary", hint=hint)
