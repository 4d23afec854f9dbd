"""What an uploader may say about a file that the file itself does not: a small JSON object beside the upload."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from typing import Annotated, Any, ClassVar, Literal, TypeVar, cast

from annotated_types import Ge, Gt, Le, Len, Lt, MaxLen
from pydantic import AfterValidator, Field, FiniteFloat, StringConstraints, TypeAdapter, ValidationError

from regnf_core.errors import FieldFormatError
from regnf_core.library_entries import LABEL_PATTERN, MOST_OF_LABEL
from regnf_core.schema.similarity import require_similarity

_Corner = Annotated[list[FiniteFloat], Len(3, 3)]


class _Said:
    """Base of a part of a description: no other members are taken, and no text for a number."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid", "strict": True}


def _sound_box(box: list[list[float]]) -> list[list[float]]:
    if not all(low < high for low, high in zip(*box, strict=True)):
        raise ValueError("the lowest corner must be below the highest corner along every axis")
    return box


def _whole_sign(sign: int) -> int:
    if sign not in (1, -1):
        raise ValueError("should be 1 or -1")
    return sign


def _similarity(rows: list[list[float]]) -> list[list[float]]:
    require_similarity(rows)
    return rows


_Row = Annotated[list[FiniteFloat], Len(4, 4)]
_Similarity = Annotated[list[_Row], Len(4, 4), AfterValidator(_similarity)]
_Box = Annotated[list[_Corner], Len(2, 2), AfterValidator(_sound_box)]


@dataclass(frozen=True)
class GridDescription(_Said):
    """Import options for a hash grid, if its layout does not follow from the size of its table. The importer searches
    for options that are left out."""

    levels: Annotated[int, Ge(1), Le(32)] | None = None
    features_per_level: Annotated[int, Ge(1), Le(32)] | None = None
    log2_table_size: Annotated[int, Ge(3), Le(24)] | None = None
    base_resolution: Annotated[int, Ge(2), Le(1024)] | None = None
    top_resolution: Annotated[int, Ge(2), Le(1 << 20)] | None = None
    per_level_scale: Annotated[float, Ge(1), Le(8)] | None = None
    """Ratio of the resolutions of neighboring levels."""
    interpolation: Literal["linear", "smoothstep"] | None = None
    radius: Annotated[float, Gt(0), Le(1e6)] | None = None
    """The grid covers [-radius, radius]^3 of the coordinates that it is given."""


@dataclass(frozen=True)
class EncodingDescription(_Said):
    """Import options for the positional encoding, if its layout does not follow from the widths of the layers."""

    degree: Annotated[int, Ge(0), Le(24)] | None = None
    """Number of frequencies."""
    used: bool | None = None
    """False: the network has the columns, but was trained with zeros in them."""
    two_pi: bool | None = None
    """Whether the sines' argument is multiplied by 2 pi."""
    base_frequency: Annotated[float, Ge(1e-3), Le(1e3)] | None = None
    """The sines' lowest frequency, in place of ``two_pi``."""
    order: Literal["frequency", "kind", "kind_frequency", "axis"] | None = None
    """How the columns are sorted. frequency: for each frequency three sines, then three cosines. kind: all sines, axis
    by axis, then all cosines; kind_frequency: the same, frequency by frequency. axis: for each axis and frequency, the
    sine and the cosine."""


Inputs = Literal["all", "no_direction", "no_gradient", "features"]


@dataclass(frozen=True)
class ColorOverrides(_Said):
    """Import options for a color network, if its layout does not follow from the widths of its layers. They do not
    change the geometry."""

    keep: bool | None = None
    """False: leave the color out."""
    average_appearance: bool | None = None
    """True: the mean of the images' appearances (sdfstudio, nerfstudio); else none of them."""
    direction_degree: Annotated[int, Ge(0), Le(24)] | None = None
    """Frequencies of the direction's sines and cosines, or the degree of its spherical harmonics."""
    inputs: Inputs | None = None
    """What the network sees: no_direction and no_gradient are NeuS's modes no_view_dir and no_normal; features:
    nothing but the geometry's results (instant-nsr-pl)."""
    hidden_width: Annotated[int, Ge(1), Le(1024)] | None = None
    """Of a fully fused network's layers."""
    padding: Annotated[float, Ge(0), Le(1)] | None = None
    """sdfstudio's rgb_padding."""
    output: Literal["sigmoid", "linear"] | None = None
    """What stands behind the last layer."""
    channels: Literal["rgb", "bgr"] | None = None
    """The order in which NeuS was trained; its own trainer reads images as bgr."""


@dataclass(frozen=True)
class CamerasDescription(_Said):
    """Import options for cameras: what is not in the camera file."""

    intrinsics: Annotated[list[Annotated[float, Gt(0), Le(1e6)]], Len(4, 4)] | None = None
    """fx, fy, cx, cy of all images, in pixels."""
    size: Annotated[list[Annotated[int, Ge(1), Le(100_000)]], Len(2, 2)] | None = None
    """Width and height of the images, in pixels; without it, twice cx and cy."""
    axes: Literal["opencv", "opengl"] | None = None
    """opencv: a camera looks along its z axis, y is down. opengl: it looks against z, y is up."""


@dataclass(frozen=True)
class UploadDescription(_Said):
    """Import options. They replace what the importer derives from the file. null: derive it."""

    family: Annotated[str, MaxLen(64)] | None = None
    contraction: Literal["none", "linf", "linf_grid"] | None = None
    """How far space is squeezed before the field sees it; see the field families' documentation."""
    level_mask: Annotated[int, Gt(0), Le(32)] | None = None
    """Only this many of the coarsest grid levels are evaluated, for checkpoints of coarse-to-fine training."""
    latent_index: Annotated[int, Ge(0), Lt(1 << 24)] | None = None
    """Which shape of a family of shapes, counted from 0 in the order of the checkpoint's latent codes."""
    latent: Annotated[list[FiniteFloat], Len(1, 512)] | None = None
    """The shape's latent code itself, where the checkpoint has none."""
    bounds: _Box | None = None
    """Lowest and highest corner of the region where the field has meaning, in its own frame, after ``world_scale``."""
    world_scale: Annotated[float, Ge(1e-6), Le(1e6)] | None = None
    """Length, in the unit overrides, of one unit of the checkpoint's coordinates; distances scale with it."""
    sign: Annotated[int, Ge(-1), Le(1), AfterValidator(_whole_sign)] | None = None
    """1: the checkpoint's values are positive in free space; -1: they are negative there."""
    up_axis: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """Which axis of the field points up. Kept with the field, changes nothing about it."""
    input_scale: Annotated[float, Ge(1e-6), Le(1e6)] | None = None
    """The factor of the coordinates before the network sees them, where no file has it."""
    output_scale: Annotated[float, Ge(1e-6), Le(1e6)] | None = None
    """The factor of the network's results, where no file has it."""
    output_bias: Annotated[float, Ge(-1e6), Le(1e6)] | None = None
    """Added to the network's result, in the checkpoint's unit."""
    output_column: Annotated[int, Ge(0), Lt(1 << 16)] | None = None
    """Which column of the last layer's result is the distance, counted from 0."""
    output_tanh: Annotated[int, Ge(0), Le(2)] | None = None
    """How often tanh is applied to the last layer's result."""
    activation: Literal["relu", "softplus", "sine", "tanh", "elu", "gelu", "silu", "leaky_relu"] | None = None
    """The function between the network's layers."""
    activation_scale: Annotated[float, Gt(0), Le(1e6)] | None = None
    """Softplus's beta, the sine's omega, or leaky_relu's slope for negative numbers."""
    first_activation_scale: Annotated[float, Gt(0), Le(1e6)] | None = None
    """The sine's omega in the first layer, where it differs from that of the others."""
    skip_factor: Annotated[float, Gt(0), Le(1e3)] | None = None
    """The factor of what a layer is given that sees the network's input again: 1, or 1 / sqrt 2."""
    skip_order: Literal["hidden_first", "input_first"] | None = None
    """What comes first in such a layer's columns."""
    skip_layer: Annotated[int, Ge(0), Le(32)] | None = None
    """How many blocks stand before the layer behind which the network sees its input again; 0: there is none."""
    truncation: Annotated[float, Ge(1e-9), Le(1e9)] | None = None
    """The distance, in the checkpoint's unit, that the value 1 of a map of truncated distances stands for."""
    frame: Literal["dataset", "field"] | None = None
    """field (the default): coordinates as the network sees them. dataset: those of the dataset, by the transform and
    the scale that the trainer applied to it, which must be known from its settings or ``dataset_transform``."""
    dataset_transform: _Similarity | None = None
    """4 x 4 matrix of a similarity, row by row: takes points of the field's frame to the dataset's."""
    as_: Annotated[Literal["scene", "object"] | None, Field(alias="as")] = None
    """scene: a surface seen from within, as a room's. object: a thing seen from around it."""
    accept_implausible: bool | None = None
    """True: import the field although it does not behave like a signed distance."""
    label: Annotated[str, StringConstraints(max_length=MOST_OF_LABEL, pattern=LABEL_PATTERN)] | None = None
    use_grid: bool | None = None
    """False: the network has a hash grid's columns, but was trained without it."""
    hash: GridDescription = field(default_factory=GridDescription)
    positional_encoding: EncodingDescription = field(default_factory=EncodingDescription)
    cameras: CamerasDescription = field(default_factory=CamerasDescription)
    color: ColorOverrides = field(default_factory=ColorOverrides)

    def non_default(self) -> dict[str, Any]:
        """The entries that say something, as plain (JSON) values."""
        values = asdict(self)
        for name in ("hash", "positional_encoding", "cameras", "color"):
            values[name] = {part: value for part, value in values[name].items() if value is not None}
        values["as"] = values.pop("as_")
        return {name: value for name, value in values.items() if value not in (None, {})}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any] | None) -> UploadDescription:
        """The description from plain (JSON) values. Raises FieldFormatError (INVALID_DESCRIPTION)."""
        return described(cls, values)


_Described = TypeVar("_Described")


def described(kind: type[_Described], values: Mapping[str, Any] | None) -> _Described:
    """A description of this kind from plain (JSON) values. Raises FieldFormatError (INVALID_DESCRIPTION)."""
    try:
        return cast(_Described, _adapter(cast(Any, kind)).validate_json(json.dumps(values or {}, allow_nan=False)))
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        raise FieldFormatError(f"description.{where}: {message}", reason="INVALID_DESCRIPTION") from error
    except (TypeError, ValueError, RecursionError) as error:
        raise FieldFormatError("the description is not JSON", reason="INVALID_DESCRIPTION") from error


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)
