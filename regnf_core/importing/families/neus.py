"""NeuS (Wang et al. 2021), and the networks of IDR, VolSDF and MonoSDF, of which it has the form: softplus layers.

NeuS's own ``scale`` is not in the checkpoint: S(x) = f(scale x) / scale. Where no settings say it, the published ones
are tried: the trainer keeps the gradient at length one where it looks, and the network's surroundings show where that
was. VolSDF's sphere round the scene is left out, as its own extraction of the surface leaves it out.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import tensor_error
from regnf_core.importing.families.color import neus as color
from regnf_core.importing.families.color.head import ReadColor, understood, with_color, with_deviation, without_color
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import (
    UNIT_CUBE,
    assumed_bounds,
    layer_names,
    read_layers,
    refuse_other_entries,
    require_family,
    shared_entries,
    state_under,
    strip_prefix,
)
from regnf_core.importing.families.network import (
    BETA,
    FORM_ENTRIES,
    Form,
    Network,
    OpenForm,
    network_field,
    skips_of,
    told,
)
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription

FAMILY = "neus"
_SCALES = (1.0, 3.0)
"""Those of the published configurations. Others are to be said: evidence tells a scale to a tenth only."""
_IMPLICIT = "implicit_network."
_RENDERING = "rendering_network."
_IMPLICIT_FAMILIES = ("volsdf", "monosdf", "idr")
MAX_DEGREE = 24


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of a NeuS, or None where the keys are not theirs.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, TENSOR_MISSING, TENSOR_SHAPE, SETTINGS_CONTRADICT_TENSORS,
    INVALID_DESCRIPTION and what TensorSource raises.
    """
    if "sdf_network_fine" not in checkpoint:
        return None
    require_family(overrides, FAMILY)
    state = strip_prefix(checkpoint["sdf_network_fine"], "")
    open_scale = overrides.input_scale is None and overrides.output_scale is None
    converted = _converted(state, source, overrides, FAMILY, "sdf_network_fine", _SCALES if open_scale else ())
    sharpness = strip_prefix(checkpoint.get("variance_network_fine"), "")
    converted = with_deviation(converted, sharpness, "variance", source)
    colors = strip_prefix(checkpoint.get("color_network_fine"), "")
    if not colors or overrides.color.keep is False:
        return converted
    return _with_color(converted, state, colors, source, overrides)


def _with_color(
    converted: ConvertedField,
    state: dict[str, Any],
    colors: dict[str, Any],
    source: TensorSource,
    overrides: UploadDescription,
) -> ConvertedField:
    last = len(layer_names(state, "lin")) - 1
    is_softplus = overrides.activation in (None, "softplus")

    def read() -> ReadColor:
        understood(not overrides.output_column, "the distance is not the first of the network's results")
        understood(last not in converted.description["input_at"], "the last layer sees the position again")
        return color.read_color(colors, state, f"lin{last}", source, overrides.color)

    # Softplus of another factor is stored as that of the usual one, of other numbers.
    return with_color(converted, read, BETA / (overrides.activation_scale or BETA) if is_softplus else 1.0)


def convert_implicit(
    checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription
) -> ConvertedField | None:
    """The same of IDR, VolSDF or MonoSDF; raises the same."""
    state = state_under(checkpoint, _IMPLICIT)
    if not strip_prefix(state, "lin0."):
        return None
    if strip_prefix(state, "encoding."):
        message = "MonoSDF's network with a hash grid is not supported: extract its mesh, and give that"
        raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
    density = bool(state_under(checkpoint, "density."))
    family = overrides.family if overrides.family in _IMPLICIT_FAMILIES else "volsdf" if density else "idr"
    require_family(overrides, family)
    converted = _converted(state, source, overrides, family, _IMPLICIT.removesuffix("."), ())
    colors = state_under(checkpoint, _RENDERING) and overrides.color.keep is not False
    return without_color(converted, [_RENDERING] if colors else [], family)


def _names(state: dict[str, Any]) -> list[str]:
    return [f"lin{name}" for name in layer_names(strip_prefix(state, "lin"), "", minimum=2)]


def _converted(
    state: dict[str, Any],
    source: TensorSource,
    overrides: UploadDescription,
    family: str,
    where: str,
    scales: tuple[float, ...],
) -> ConvertedField:
    refuse_other_entries(overrides, family, FORM_ENTRIES)
    names = _names(state)
    layers = read_layers(state, names, source, column=overrides.output_column or 0)
    degree, rest = divmod(layers.input_width - 3, 6)
    if rest or not 0 <= degree <= MAX_DEGREE:
        raise tensor_error(f"lin0 has {layers.input_width} columns, expected 3 + 6 x frequencies", "TENSOR_SHAPE")
    network = Network(layers, skips_of(layers, names))
    form = Form("softplus", degree=degree, skip_factor=math.sqrt(0.5)).said(scaled(overrides))
    forms = [OpenForm("as the description says", form, family)]
    if scales:
        forms = [_at_scale(form, scale, overrides.world_scale or 1.0) for scale in scales]
    why = (f"keys {where}.lin*, {len(names)} layers, {degree} frequencies", *assumed_bounds(overrides))
    return network_field(network, forms, shared_entries(overrides, UNIT_CUBE), why)


def _at_scale(form: Form, scale: float, world_scale: float) -> OpenForm:
    """The trainer looks at the unit sphere."""
    at_scale = replace(form, input_scale=scale, output_scale=1.0 / scale)
    return OpenForm(told(input_scale=scale), at_scale, FAMILY, ends_at=world_scale)


def scaled(overrides: UploadDescription) -> UploadDescription:
    """With both factors where one is said: S(x) = f(s x) / s."""
    given, made = overrides.input_scale, overrides.output_scale
    if given is not None and made is None:
        return replace(overrides, output_scale=1.0 / given)
    if made is not None and given is None:
        return replace(overrides, input_scale=1.0 / made)
    return overrides
