"""PIN-SLAM's map (Pan et al. 2024): a pickled object of neural points, and the decoder's weights beside it.

The object is never made. What the file would have given it as attributes is read as plain values and tensors: the
points, their features, and the configuration that the map was made with.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, require_shape, tensor_error
from regnf_core.importing.families.color.head import without_color
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import (
    Layers,
    layer_names,
    read_layers,
    refuse_other_entries,
    require_extra_columns,
    require_family,
    shared_entries,
    strip_prefix,
)
from regnf_core.importing.pickle.pickle_machine import Placeholder
from regnf_core.importing.tensor_source import TensorSource, lookup
from regnf_core.importing.upload_description import UploadDescription

FAMILY = "pin_slam"
_OBJECT = "NeuralPoints"
_UNKNOWN_OPTIONS = ("layer_norm_on", "use_gaussian_pe", "pos_encoding_band", "mlp_leaky_relu")


@dataclass(frozen=True)
class _Settings:
    """Of the map's configuration what the function depends on."""

    cell_size: float
    buffer_size: int
    neighbor_cells: int
    search_alpha: float
    neighbors: int
    blend_first: bool
    oriented: bool
    distance_scale: float


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of such a map, or None where there are no neural points.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, INVALID_DESCRIPTION, TENSOR_MISSING, TENSOR_SHAPE and what
    TensorSource raises.
    """
    if "neural_points" not in checkpoint:
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY)
    attributes = _attributes(checkpoint["neural_points"], _OBJECT)
    settings = _settings(attributes)
    layers = _decoder(checkpoint.get("sdf"), source, settings.distance_scale)
    tensors, low, high = _map(attributes, source, settings)
    width = tensors["features"].shape[1] + 3
    if layers.input_width != width:
        raise tensor_error(f"sdf.layers.0 has {layers.input_width} columns, expected {width}", "TENSOR_SHAPE")
    description = {
        "kind": "neural_points",
        **shared_entries(overrides, [(low - settings.cell_size).tolist(), (high + settings.cell_size).tolist()]),
        "cell_size": settings.cell_size,
        "buffer_size": settings.buffer_size,
        "reach": settings.neighbor_cells + settings.search_alpha,
        "max_distance": 3.0**0.5 * (settings.neighbor_cells + 1) * settings.cell_size,
        "neighbors": settings.neighbors,
        "blend_first": settings.blend_first,
        "oriented": settings.oriented,
        "source": {"family": FAMILY},
    }
    order = "blended, then decoded" if settings.blend_first else "decoded, then blended"
    why = (
        f"an object {_OBJECT} under neural_points: {len(tensors['points'])} points, features {order}",
        f"distances are the decoder's outputs times {settings.distance_scale:g}",
    )
    converted = ConvertedField(FAMILY, why, description, {**tensors, **layers.tensors()})
    colors = isinstance(checkpoint.get("color"), dict) and overrides.color.keep is not False
    return without_color(converted, ["color"] if colors else [], FAMILY)


def _attributes(value: object, kind: str) -> Mapping[Any, Any]:
    """What the file would have given an object of the class ``kind`` as its attributes."""
    if isinstance(value, Placeholder) and value.full_name.rsplit(".", 1)[-1] == kind and isinstance(value.state, dict):
        return value.state
    raise FieldFormatError(f"no object of {kind} with its attributes", reason="FAMILY_NOT_SUPPORTED")


def _settings(attributes: Mapping[Any, Any]) -> _Settings:
    config = _attributes(attributes.get("config"), "Config")
    for name in _UNKNOWN_OPTIONS:
        if config.get(name):
            raise FieldFormatError(f"a map made with {name} is not supported", reason="FAMILY_NOT_SUPPORTED")
    if config.get("idw_index", 2) != 2:
        raise FieldFormatError("blending with a power other than 2 is not supported", reason="FAMILY_NOT_SUPPORTED")
    scale = 1.0
    if config.get("main_loss_type") == "bce":
        scale = _number(config, "logistic_gaussian_ratio") * _number(config, "sigma_sigmoid_m")
    return _Settings(
        cell_size=_number(attributes, "resolution"),
        buffer_size=int(_number(attributes, "buffer_size")),
        neighbor_cells=int(_number(config, "num_nei_cells")),
        search_alpha=_number(config, "search_alpha"),
        neighbors=int(_number(config, "query_nn_k")),
        blend_first=bool(config.get("weighted_first")),
        oriented=bool(attributes.get("after_pgo")),
        distance_scale=scale,
    )


def _number(values: Mapping[Any, Any], name: str) -> float:
    value = values.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < 1e15:
        raise FieldFormatError(f"{name} is missing in the map's settings, or is not a number", reason="TENSOR_MISSING")
    return float(value)


def _decoder(value: object, source: TensorSource, scale: float) -> Layers:
    """The decoder's layers, the factor of its result folded into the last."""
    state = strip_prefix(value, "")
    if not state:
        raise tensor_error("sdf, the decoder's weights, is missing", "TENSOR_MISSING")
    names = [*layer_names(state, "layers.", minimum=1), "lout"]
    layers = read_layers(state, names, source, has_biases="lout.bias" in state)
    require_extra_columns(layers, names)
    return layers.times(scale)


def _map(
    attributes: Mapping[Any, Any], source: TensorSource, settings: _Settings
) -> tuple[dict[str, Float32Array], Float32Array, Float32Array]:
    """The map's tensors by their names in the field file, and the points' lowest and highest coordinates (3,)."""
    held = {
        **strip_prefix(attributes, ""),
        **strip_prefix(attributes.get("_parameters"), ""),
        **strip_prefix(attributes.get("_buffers"), ""),
    }
    points = source.array("neural_points", lookup(held, "neural_points"))
    require_shape("neural_points", points, (None, 3))
    features = source.array("geo_features", lookup(held, "geo_features"))
    require_shape("geo_features", features, (len(points) + 1, None))  # the last row stands for points out of reach
    tensors = {"points": points, "features": features[:-1]}
    if settings.oriented:
        tensors["orientations"] = source.array("point_orientations", lookup(held, "point_orientations"))
        require_shape("point_orientations", tensors["orientations"], (len(points), 4))
    return tensors, points.min(axis=0), points.max(axis=0)
