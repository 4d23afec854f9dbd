"""What a person may say of a recording that its files do not. Without pydantic: the process that imports has none."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Le, MaxLen


@dataclass(frozen=True)
class RecordingDescription:
    """Import options of a recording, if a value is missing or wrong in its files. null: the value of the layout."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid", "strict": True}

    depth_unit: Annotated[float, Ge(1e-6), Le(1)] | None = None
    """Meters that a step of the depth images stands for."""
    layout: Annotated[str, MaxLen(200)] | None = None
    """The layout's name, where another one is found: bop, tum, rosbag2:/topic/of/depth ..."""
    camera_axes: Literal["opencv", "opengl"] | None = None
    """opencv: cameras look along z, y is down. opengl: they look against z, y is up."""
    intrinsics: dict[str, Any] | None = None
    """Of the depth images' camera, as a `camera.json` beside images has them."""

    def non_default(self) -> dict[str, Any]:
        """The entries that say something, as plain (JSON) values."""
        return {name: value for name, value in asdict(self).items() if value is not None}
