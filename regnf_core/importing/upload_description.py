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
    """The grid covers [-radius, radius]^3 of its input coordinates."""


@dataclass(frozen=True)
class EncodingDescription(_Said):
    """Import options for the positional encoding, if its layout does not follow from the widths of the layers."""

    degree: Annotated[int, Ge(0), Le(24)] | None = None
    """Number of frequencies."""
    used: bool | None = None
    """False: the network has the columns, but was trained with zeros as their input."""
    two_pi: bool | None = None
    """Whether the argument of the sines is multiplied by 2 pi."""
    base_frequency: Annotated[float, Ge(1e-3), Le(1e3)] | None = None
    """The lowest frequency of the sines, instead of ``two_pi``."""
    order: Literal["frequency", "kind", "kind_frequency", "axis"] | None = None
    """The order of the columns. frequency: for each frequency three sines, then three cosines. kind: all sines, axis
    by axis, then all cosines; kind_frequency: the same, frequency by frequency. axis: for each axis and frequency, the
    sine and the cosine."""


Inputs = Literal["all", "no_direction", "no_gradient", "features"]


@dataclass(frozen=True)
class ColorOverrides(_Said):
    """Import options for a color network, if its layout does not follow from the widths of its layers. They do not
    change the geometry."""

    keep: bool | None = None
    """False: do not import the color."""
    average_appearance: bool | None = None
    """True: use the mean of the appearance embeddings of all images (sdfstudio, nerfstudio). False: use zeros."""
    direction_degree: Annotated[int, Ge(0), Le(24)] | None = None
    """Frequencies of the direction's sines and cosines, or the degree of its spherical harmonics."""
    inputs: Inputs | None = None
    """The inputs of the network. no_direction and no_gradient: NeuS's modes no_view_dir and no_normal. features: only
    the outputs of the geometry network (instant-nsr-pl)."""
    hidden_width: Annotated[int, Ge(1), Le(1024)] | None = None
    """Width of the layers of a fully fused network."""
    padding: Annotated[float, Ge(0), Le(1)] | None = None
    """sdfstudio's rgb_padding."""
    output: Literal["sigmoid", "linear"] | None = None
    """The function after the last layer."""
    channels: Literal["rgb", "bgr"] | None = None
    """The order of the color channels in NeuS's training. Its own trainer reads images as bgr."""


@dataclass(frozen=True)
class CamerasDescription(_Said):
    """Import options for cameras: what is not in the camera file."""

    intrinsics: Annotated[list[Annotated[float, Gt(0), Le(1e6)]], Len(4, 4)] | None = None
    """fx, fy, cx, cy of all images, in pixels."""
    size: Annotated[list[Annotated[int, Ge(1), Le(100_000)]], Len(2, 2)] | None = None
    """Width and height of the images, in pixels; without it, twice cx and cy."""
    axes: Literal["opencv", "opengl"] | None = None
    """opencv: a camera looks along +z, and y is down. opengl: it looks along -z, and y is up."""


@dataclass(frozen=True)
class UploadDescription(_Said):
    """Import options. They replace what the importer derives from the file. null: derive it."""

    family: Annotated[str, MaxLen(64)] | None = None
    contraction: Literal["none", "linf", "linf_grid"] | None = None
    """The contraction of space before the network; see docs/families.md."""
    level_mask: Annotated[int, Gt(0), Le(32)] | None = None
    """Number of grid levels that are evaluated, from the coarsest, for checkpoints of coarse-to-fine training."""
    latent_index: Annotated[int, Ge(0), Lt(1 << 24)] | None = None
    """Index of the shape, for a network of several shapes: the position of its latent code in the checkpoint, from
    0."""
    latent: Annotated[list[FiniteFloat], Len(1, 512)] | None = None
    """The latent code of the shape, if the checkpoint has none."""
    bounds: _Box | None = None
    """Lowest and highest corner of the region in which the field is valid, in its own frame, after ``world_scale``."""
    world_scale: Annotated[float, Ge(1e-6), Le(1e6)] | None = None
    """Length of one unit of the checkpoint's coordinates, in the unit of the imported field. Distances scale with
    it."""
    sign: Annotated[int, Ge(-1), Le(1), AfterValidator(_whole_sign)] | None = None
    """1: the checkpoint's values are positive in free space; -1: they are negative there."""
    up_axis: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """The up axis of the field. It is stored with the field and does not change it."""
    input_scale: Annotated[float, Ge(1e-6), Le(1e6)] | None = None
    """Factor of the coordinates before the network, if no file has it."""
    output_scale: Annotated[float, Ge(1e-6), Le(1e6)] | None = None
    """Factor of the network's output, if no file has it."""
    output_bias: Annotated[float, Ge(-1e6), Le(1e6)] | None = None
    """Value that is added to the network's output, in the checkpoint's unit."""
    output_column: Annotated[int, Ge(0), Lt(1 << 16)] | None = None
    """Index of the distance in the output of the last layer, from 0."""
    output_tanh: Annotated[int, Ge(0), Le(2)] | None = None
    """How often tanh is applied to the output of the last layer."""
    activation: Literal["relu", "softplus", "sine", "tanh", "elu", "gelu", "silu", "leaky_relu"] | None = None
    """The activation function between the layers of the network."""
    activation_scale: Annotated[float, Gt(0), Le(1e6)] | None = None
    """The parameter of the activation: softplus's beta, the sine's omega, or leaky_relu's slope for negative
    numbers."""
    first_activation_scale: Annotated[float, Gt(0), Le(1e6)] | None = None
    """The sine's omega in the first layer, if it differs from that of the other layers."""
    skip_factor: Annotated[float, Gt(0), Le(1e3)] | None = None
    """Factor of the inputs of a layer with a skip connection: 1, or 1 / sqrt 2."""
    skip_order: Literal["hidden_first", "input_first"] | None = None
    """The order of the inputs of a layer with a skip connection."""
    skip_layer: Annotated[int, Ge(0), Le(32)] | None = None
    """Number of blocks before the skip connection; 0: there is no skip connection."""
    truncation: Annotated[float, Ge(1e-9), Le(1e9)] | None = None
    """The distance that corresponds to the value 1 of a map of truncated distances, in the checkpoint's unit."""
    frame: Literal["dataset", "field"] | None = None
    """field (the default): the coordinates of the network. dataset: those of the dataset. They follow from the
    transform and the scale of the trainer, which must be in its config file or in ``dataset_transform``."""
    dataset_transform: _Similarity | None = None
    """Row-major 4x4 matrix of a similarity transform. It maps points of the field's frame to the dataset's."""
    as_: Annotated[Literal["scene", "object"] | None, Field(alias="as")] = None
    """scene: a surface seen from inside, such as a room. object: a surface seen from outside."""
    sensor: _Corner | None = None
    """The position from which all points of a cloud were measured, in the file's coordinates."""
    node: Annotated[str, Len(1, 512)] | None = None
    """Of a scene of several nodes the one to import, with all below it: its name, or the names of a path to it with
    ``/`` between them. A prim of USD, a product of STEP, an object of 3MF, or a link of URDF."""
    accept_implausible: bool | None = None
    """True: import the field although it does not behave like a signed distance."""
    label: Annotated[str, StringConstraints(max_length=MOST_OF_LABEL, pattern=LABEL_PATTERN)] | None = None
    use_grid: bool | None = None
    """False: the network has the columns of a hash grid, but was trained without it."""
    hash: GridDescription = field(default_factory=GridDescription)
    positional_encoding: EncodingDescription = field(default_factory=EncodingDescription)
    cameras: CamerasDescription = field(default_factory=CamerasDescription)
    color: ColorOverrides = field(default_factory=ColorOverrides)

    def non_default(self) -> dict[str, Any]:
        """The given import options, as plain (JSON) values."""
        values = asdict(self)
        for name in ("hash", "positional_encoding", "cameras", "color"):
            values[name] = {part: value for part, value in values[name].items() if value is not None}
        values["as"] = values.pop("as_")
        return {name: value for name, value in values.items() if value not in (None, {})}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any] | None) -> UploadDescription:
        """The import options from plain (JSON) values. Raises FieldFormatError (INVALID_DESCRIPTION)."""
        return described(cls, values)


_Described = TypeVar("_Described")


def described(kind: type[_Described], values: Mapping[str, Any] | None) -> _Described:
    """Import options of this kind from plain (JSON) values. Raises FieldFormatError (INVALID_DESCRIPTION)."""
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
