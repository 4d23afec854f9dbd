"""What an uploader may say about a file that the file itself does not: a small JSON object beside the upload."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Gt, Le, MaxLen
from pydantic import TypeAdapter, ValidationError

from regnf_core.errors import FieldFormatError

_FORBID_UNKNOWN: dict[str, Any] = {"extra": "forbid", "strict": True}


@dataclass(frozen=True)
class GridDescription:
    """What the table's size alone may leave open about a hash grid. Anything left out is searched for."""

    __pydantic_config__: ClassVar[dict[str, Any]] = _FORBID_UNKNOWN

    features_per_level: Annotated[int, Ge(1), Le(32)] | None = None
    base_resolution: Annotated[int, Ge(2), Le(1024)] | None = None
    top_resolution: Annotated[int, Ge(2), Le(1 << 20)] | None = None
    interpolation: Literal["linear", "smoothstep"] | None = None


@dataclass(frozen=True)
class UploadDescription:
    """Overrides of what the gate would conclude by itself. None means: conclude it."""

    __pydantic_config__: ClassVar[dict[str, Any]] = _FORBID_UNKNOWN

    family: Annotated[str, MaxLen(64)] | None = None
    contraction: Literal["none", "linf", "linf_grid"] | None = None
    """How far space is squeezed before the field sees it; see the field families' documentation."""
    level_mask: Annotated[int, Gt(0), Le(32)] | None = None
    """Only this many of the coarsest grid levels are evaluated, for checkpoints of coarse-to-fine training."""
    label: Annotated[str, MaxLen(200)] | None = None
    hash: GridDescription = field(default_factory=GridDescription)

    @classmethod
    def from_dict(cls, values: dict[str, Any] | None) -> UploadDescription:
        """The description from plain (JSON) values. Raises FieldFormatError (INVALID_DESCRIPTION)."""
        try:
            return _ADAPTER.validate_json(json.dumps(values or {}, allow_nan=False))
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            where = ".".join(str(part) for part in first["loc"])
            raise FieldFormatError(f"description.{where}: {first['msg']}", reason="INVALID_DESCRIPTION") from error
        except (TypeError, ValueError, RecursionError) as error:
            raise FieldFormatError("the description is not JSON", reason="INVALID_DESCRIPTION") from error


_ADAPTER = TypeAdapter(UploadDescription)
