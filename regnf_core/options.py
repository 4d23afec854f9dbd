"""Options of a registration, grouped by stage. Torch-free: the HTTP contract is derived from them.

Every length is in normalized field units unless its name says otherwise, as in the paper.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Gt, Le

from regnf_core.errors import InvalidOptionsError, nearest_name

if TYPE_CHECKING:
    from pydantic import TypeAdapter

Unit = Literal["auto", "m", "cm", "mm", "in", "free"]
METERS: dict[Unit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""The units with a known length."""
_UNIT_TOLERANCE = 0.01
"""Largest relative error of a scale that follows from a unit. It covers the scale errors of sensors."""
Preset = Literal["paper", "robust"]
Axis = Literal["x", "y", "z"]
Acceptance = Literal["default", "strict"]
_Ratio = Annotated[float, Gt(0), Le(1)]
_Share = Annotated[float, Ge(0), Le(1)]
_Scale = Annotated[float, Ge(1e-6), Le(1e6)] | None


class _Group:
    """Base of a group of options. Unknown options are refused. The docstring below an option is its description."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid", "use_attribute_docstrings": True}


@dataclass(frozen=True)
class SamplingOptions(_Group):
    """Multi-view surface sampling (paper, section III-C.1)."""

    views: Annotated[int, Ge(1), Le(64)] = 5
    """Number of cameras around the box, all looking at its center. More views cover hollow shapes better."""
    scene_camera_distance: Annotated[float, Gt(0), Le(100)] = 0.9
    """Distance of the scene's cameras from the box's center, scene units."""
    object_camera_distance: Annotated[float, Gt(0), Le(100)] = 0.7
    """Distance of the object's cameras from its center, object units."""
    image_size: Annotated[int, Ge(8), Le(4096)] = 512
    """Edge of the virtual image, pixels."""
    pixel_stride: Annotated[int, Ge(1), Le(512)] = 8
    """Distance between rays along both image axes, pixels."""
    ground_fraction: Annotated[float, Ge(0), Le(0.5)] = 0.025
    """Points in this lowest share of the box's height, along ``up_axis``, are removed as ground."""


@dataclass(frozen=True)
class InitializationOptions(_Group):
    """FPFH features, RANSAC and ICP (paper, section III-C.2)."""

    voxel_size: Annotated[float, Gt(0), Le(10)] = 0.025
    """Voxel size for downsampling before the features are computed, field units."""
    ransac_distance_voxels: Annotated[float, Gt(0), Le(100)] = 1.5
    """Largest distance of a RANSAC inlier, in voxels."""
    edge_length_ratio: _Ratio = 0.9
    """Minimum ratio of corresponding edge lengths. RANSAC drops a draw of correspondences with a smaller ratio."""
    ransac_iterations: Annotated[int, Ge(1), Le(10_000_000)] = 100_000
    icp_distance_voxels: Annotated[float, Gt(0), Le(100)] = 0.4
    """Largest distance of an ICP correspondence, in voxels."""
    draws: Annotated[int, Ge(1), Le(256)] = 1
    """Number of independent RANSAC runs. The one that fits both fields best is kept. 1 is the published method. 8 take
    about a second more and reduce the risk of a wrong orientation."""


@dataclass(frozen=True)
class OptimizationOptions(_Group):
    """The bidirectional loss and its minimization (paper, sections III-D and III-E)."""

    iterations: Annotated[int, Ge(1), Le(10_000)] = 200
    translation_rate: Annotated[float, Gt(0), Le(1)] = 0.01
    rotation_rate: Annotated[float, Gt(0), Le(1)] = 0.02
    scale_rate: Annotated[float, Gt(0), Le(1)] = 0.01
    kernel_rate: Annotated[float, Gt(0), Le(1)] = 0.005
    regularizer_weight: Annotated[float, Ge(0), Le(1000)] = 1.0
    """Weight w of the nearest-neighbor regularizer. The paper gives no value."""
    stop_residual: Annotated[float, Ge(0), Le(1)] = 0.0005
    """Stop when the mean residuals of both directions are at most this."""
    samples_per_iteration: Annotated[int, Ge(16), Le(1_000_000)] = 2000
    """Number of samples of each set for the expectations of the loss. They are drawn again in every iteration. The
    paper gives no number. Fewer are faster, because field evaluations take most of the time."""


@dataclass(frozen=True)
class ResamplingOptions(_Group):
    """Algorithm 1: new samples near both surfaces."""

    every: Annotated[int, Ge(1), Le(10_000)] = 10
    """Iterations between resamplings."""
    own_distance: Annotated[float, Gt(0), Le(10)] = 0.01
    """omega_1: largest |distance| to the sampled field's surface."""
    other_distance: Annotated[float, Gt(0), Le(10)] = 0.02
    """omega_2: largest |distance| to the other field's surface."""
    residual: Annotated[float, Gt(0), Le(10)] = 0.02
    """xi: largest residual."""
    radius_fraction: Annotated[float, Gt(0), Le(1)] = 0.05
    """rho, as a share of the scene's radius."""
    max_samples: Annotated[int, Ge(16), Le(1_000_000)] = 5000


@dataclass(frozen=True)
class RobustOptions(_Group):
    """The preset `robust`: a search over all of Sim(3), refinement on the fields, and a verdict.

    Lengths are in object diameters, shares are from 0 to 1. Nothing depends on the units of the fields.
    """

    rotations: Annotated[int, Ge(24), Le(20_000)] = 600
    """Number of start rotations of the search, evenly spread over all orientations. With ``up_axis`` the search uses a
    tenth of them, about this axis. Increase it if an obvious pose was missed; the search time grows in proportion."""
    feature_draws: Annotated[int, Ge(0), Le(64)] = 4
    """Number of feature matches (FPFH and RANSAC, at any scale) from which a second search starts. The second search
    runs if the result of the first one is rejected or its probability is below 0.95. Each match takes about 0.1 s.
    Increase it for heavy clutter; 0 turns the second search off."""
    scene_samples: Annotated[int, Ge(200), Le(100_000)] = 4000
    """Maximum number of samples of the scene's surface in the detection box. Increase it for an object that is small in
    its box."""
    object_samples: Annotated[int, Ge(200), Le(100_000)] = 2500
    """Maximum number of samples of the object's surface. Increase it for thin parts."""
    box_tolerance: Annotated[float, Ge(0), Le(10)] = 1.0
    """How far the object may extend beyond each face of the detection box, as a share of the box's edge. For an edge
    shorter than a fifth of the box's diagonal, it is a share of that fifth. Increase it if the box contains only a part
    of the object."""
    min_scale: _Scale = None
    """Minimum scale factor of T_object_scene: object units per scene unit. Give it and ``max_scale`` if the scale is
    approximately known, for example 0.97 and 1.03 if both fields are metric. More objects that were observed from one
    side only are then found. null: unknown."""
    max_scale: _Scale = None
    """Maximum scale factor of T_object_scene; see ``min_scale``. If both are the same number, the scale is fixed."""
    object_unit: Unit = "auto"
    """The unit of the object's file. If the scene is metric (a recording or a field in meters), it determines the scale
    within 1 %. `auto`: for a recording, the unit in which the object's size matches the observed surface, otherwise
    unknown. `free`: unknown."""
    held_out_share: Annotated[float, Gt(0), Le(0.5)] = 0.5
    """Share (0..1) of the samples that the refinement does not use: the verification samples, on which the verdict is
    based. A larger share makes the verdict more reliable and the pose less accurate."""
    inlier_distance: Annotated[float, Gt(0), Le(0.2)] = 0.015
    """Maximum |residual| of an inlier, object diameters. Increase it for coarse or noisy fields."""
    acceptance: Acceptance = "default"
    """Named level that the ``probability`` of an accepted result must reach. Use `strict` if a wrong pose costs more
    than a missed one."""
    min_probability: _Share | None = None
    """Minimum ``probability`` (0..1) of an accepted result, instead of the level of ``acceptance``. Results below it
    are `rejected`. null: the value of the level."""
    rival_margin: Annotated[float, Ge(0), Le(1)] = 0.05
    """Margin for alternatives. Another pose is listed as an alternative if its score (0..1, lower is better) exceeds
    the best score by at most this plus 0.15 times the best score, and if it is at most 20 times less probable. Increase
    it to list less exact symmetry equivalents too."""

    def __post_init__(self) -> None:
        if self.min_scale is not None and self.max_scale is not None and self.min_scale > self.max_scale:
            raise ValueError(f"min_scale {self.min_scale:g} is larger than max_scale {self.max_scale:g}")

    @property
    def scale_range(self) -> tuple[float | None, float | None]:
        """The scale's range: the given one, else the one that follows from the object's unit, for a scene in meters."""
        if (self.min_scale, self.max_scale) != (None, None) or self.object_unit not in METERS:
            return self.min_scale, self.max_scale
        scale = 1.0 / METERS[self.object_unit]
        return scale * (1.0 - _UNIT_TOLERANCE), scale * (1.0 + _UNIT_TOLERANCE)


@dataclass(frozen=True)
class RegistrationOptions(_Group):
    """All options of one registration, grouped by stage.

    The group ``robust`` is for the preset `robust`; the other groups are for the preset `paper`, with the published
    values. Options of the other preset are ignored.
    """

    preset: Preset = "robust"
    """The method. `robust` needs no initial guess. `paper` is the published method."""
    up_axis: Axis | None = None
    """The vertical axis of scene and object. `robust`: only rotations about this axis are searched, which is faster,
    and no pose is tilted by more than 30 degrees; null searches all orientations. `paper`: it defines the ground and
    the side from which the cameras look; null means z."""
    sampling: SamplingOptions = field(default_factory=SamplingOptions)
    initialization: InitializationOptions = field(default_factory=InitializationOptions)
    optimization: OptimizationOptions = field(default_factory=OptimizationOptions)
    resampling: ResamplingOptions = field(default_factory=ResamplingOptions)
    robust: RobustOptions = field(default_factory=RobustOptions)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> RegistrationOptions:
        """Options from plain (JSON) values. Options that are left out keep their defaults.

        Raises InvalidOptionsError for the first invalid option.
        """
        if not values:
            return cls()
        from pydantic import ValidationError

        try:
            read = _adapter().validate_python(values, strict=False)
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            where = ".".join(str(part) for part in first["loc"])
            hint = did_you_mean(first["loc"]) if first["type"] == UNKNOWN_OPTION else ""
            what = "no such option" if first["type"] == UNKNOWN_OPTION else first["msg"]
            raise InvalidOptionsError(f"options.{where}: {what}{hint}") from error
        _refuse_other_types(values, read)
        return read

    def to_dict(self) -> dict[str, Any]:
        """Plain values of every option, defaults included, in a fixed order."""
        return asdict(self)

    def require_robust(self, feature: str, reason: str = InvalidOptionsError.reason) -> None:
        """Raises InvalidOptionsError with ``reason`` under another preset. feature: what only `robust` can do."""
        if self.preset != "robust":
            message = f"only the preset `robust` {feature}; the options have `{self.preset}`"
            raise InvalidOptionsError(message, reason=reason)


def _refuse_other_types(given: Mapping[str, Any], read: Any, place: str = "options") -> None:
    """Raises InvalidOptionsError for a number written as a text or a truth value, as the HTTP interface refuses it."""
    for name, value in given.items():
        taken = getattr(read, name)
        if isinstance(value, Mapping):
            _refuse_other_types(value, taken, f"{place}.{name}")
        elif isinstance(value, str | bool) and type(value) is not type(taken):
            what, hint = "true or false", None
            if isinstance(value, str):
                what, hint = "a text", "Remove the quotation marks."
            wanted = "true or false" if isinstance(taken, bool) else "a number"
            raise InvalidOptionsError(f"{place}.{name}: is {what}, expected {wanted}", hint=hint)


OptionsLike = RegistrationOptions | Mapping[str, Any] | None
"""Options, or a dictionary of the options that differ from their defaults."""


def options_of(options: OptionsLike) -> RegistrationOptions:
    """The options of a caller. Raises InvalidOptionsError for the first invalid one."""
    if options is None:
        return RegistrationOptions()
    if isinstance(options, RegistrationOptions):
        return options
    if isinstance(options, Mapping):
        return RegistrationOptions.from_dict(dict(options))
    hint = 'Write {"up_axis": "z"} or RegistrationOptions(up_axis="z"); docs/api.md lists every option with its range.'
    raise InvalidOptionsError(f"options is a {type(options).__name__}, expected a dictionary", hint=hint)


def seed_of(seed: Any) -> int:
    """A seed in the form that every interface accepts. Raises InvalidOptionsError."""
    try:
        found = -1 if isinstance(seed, bool) else operator.index(seed)
    except TypeError:
        found = -1
    if not 0 <= found < 2**32:
        raise InvalidOptionsError(f"the seed is {seed!r:.40}, expected a whole number from 0 to {2**32 - 1}")
    return found


_LIMITS_OF_SHARES = {
    *("share_limits_below", "min_inlier_share", "min_explained_share", "max_free_space_violations"),
    *("max_occluded_share", "max_hidden_share"),
}
"""Options of earlier versions."""


def did_you_mean(location: Sequence[str | int]) -> str:
    """A hint for an unknown option: "; did you mean `up_axis`?", the option that replaces it, or an empty text.

    location: the option's path below ``options``, as pydantic gives it.
    """
    *group, name = (str(part) for part in location)
    if name in _LIMITS_OF_SHARES:
        return "; only the probability decides: see `robust.acceptance`"
    names = _names()
    elsewhere = [other for other, known in names.items() if name in known]
    if elsewhere:
        return f"; did you mean `{'.'.join((*elsewhere[0], name))}`?"
    near = nearest_name(name, names.get(tuple(group), ()))
    return f"; did you mean `{'.'.join((*group, near))}`?" if near else ""


def _names() -> dict[tuple[str, ...], list[str]]:
    """The names of the options of every group; the group () is the top level."""
    names: dict[tuple[str, ...], list[str]] = {(): [one.name for one in fields(RegistrationOptions)]}
    for one in fields(RegistrationOptions):
        if callable(one.default_factory):
            names[one.name,] = [option.name for option in fields(one.default_factory())]
    return names


UNKNOWN_OPTION = "unexpected_keyword_argument"
"""The type of pydantic's error about an unknown option."""


@cache
def _adapter() -> TypeAdapter[RegistrationOptions]:
    """Made when options are read. Making it takes 0.04 s, and the defaults do not need it."""
    from pydantic import TypeAdapter

    return TypeAdapter(RegistrationOptions)
