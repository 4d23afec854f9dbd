"""What may be chosen of a rendering: plain data, without torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Gt, Le
from pydantic import FiniteFloat, TypeAdapter, ValidationError

from regnf_core.errors import InvalidInputError, InvalidOptionsError
from regnf_core.rgb import Rgb

MOST_PIXELS = 1 << 24
"""Of one frame."""
MOST_FRAMES = 2000
MOST_PIXELS_IN_ALL = 1 << 30


@dataclass(frozen=True)
class RenderOptions:
    """Of all frames of one rendering."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid", "use_attribute_docstrings": True}

    mode: Literal["surface", "volume"] = "surface"
    """surface: where rays first meet the zero level. volume: NeuS's opacity along the ray; it shows how sharp a field
    is, and takes three to four times as long."""
    coloring: Literal["auto", "field", "shaded"] = "auto"
    """auto: the field's colors where it has some, else shading. field: an error where it has none. shaded: never."""
    tints: bool = True
    """Whether what was edited has its tint."""
    antialias: Annotated[int, Ge(1), Le(4)] = 1
    """Rays along each side of a pixel, for colors, normals and opacity; depths are of the pixels' middles or beside."""
    background: Rgb = (1.0, 1.0, 1.0)
    """Where a ray meets nothing."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"
    """Where more light comes from, for shading; the scene's frame."""
    cut_away: bool = False
    """Whether a camera may stand in matter, as one of an orbit always may: its rays then begin where they leave it.
    Matter at the bounds is always cut away before a camera outside of them."""
    inverse_deviation: Annotated[FiniteFloat, Gt(0), Le(1e9)] | None = None
    """NeuS's s, per scene unit, for mode volume. None: the field's own where it was learned, else 2000 over its
    bounds' diagonal."""
    memory_mb: Annotated[int, Ge(16), Le(65536)] = 256
    """What a tile's rays may take, about. It bounds the size of tiles and changes nothing else."""

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> RenderOptions:
        """From plain (JSON) values. Raises InvalidOptionsError naming the first faulty one."""
        try:
            return _ADAPTER.validate_python(values)
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            where = ".".join(str(part) for part in first["loc"])
            raise InvalidOptionsError(f"options.{where}: {first['msg']}") from error


_ADAPTER = TypeAdapter(RenderOptions)


def check_extent(frames: int, pixels: int) -> None:
    """Raises InvalidInputError (RENDER_TOO_LARGE): too many frames, or too many pixels in one (all of one size)."""
    if frames > MOST_FRAMES:
        raise _too_large(f"{frames} frames, at most {MOST_FRAMES} are rendered at once")
    if pixels > MOST_PIXELS:
        raise _too_large(f"a frame of {pixels} pixels, at most {MOST_PIXELS} are rendered")
    if frames * pixels > MOST_PIXELS_IN_ALL:
        raise _too_large(f"{frames * pixels} pixels in all frames, at most {MOST_PIXELS_IN_ALL} are rendered at once")


def _too_large(message: str) -> InvalidInputError:
    return InvalidInputError(message, reason="RENDER_TOO_LARGE", hint="Ask for fewer or smaller frames.")
