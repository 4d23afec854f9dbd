"""instant-nsr-pl: parsed.yaml, the configuration after all substitutions, as OmegaConf writes it."""

from __future__ import annotations

import re

from regnf_core.importing.families.layers import contradiction
from regnf_core.importing.settings.documents import Documents, mappings
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.settings.said import Said

_GEOMETRY = "model.geometry"
_ENCODING = f"{_GEOMETRY}.xyz_encoding_config"
_NETWORK = f"{_GEOMETRY}.mlp_network_config"
_TEXTURE = "model.texture"
_COLORS = {"volume-radiance": None, "volume-color": "features"}
"""What the color's kinds see besides the usual."""
_PROGRESSIVE = "ProgressiveBandHashGrid"
_ACTIVATION = re.compile(r"(mul|scale|clamp|[+-])?(.*)")


def main_file(documents: Documents) -> Keys | None:
    """The file that is one of theirs."""
    return next((keys for keys in mappings(documents) if isinstance(keys.find(_ENCODING), dict)), None)


def translate(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED, SETTINGS_CONTRADICT_TENSORS, FAMILY_NOT_SUPPORTED."""
    said.put("family", "instant_nsr_pl", keys, "model.name")
    _grid(keys.below(_ENCODING), said)
    _network(keys.below(_NETWORK), keys.below(_GEOMETRY), said)
    said.about_color(lambda: _color(keys.below(_TEXTURE), said))
    _radius(keys, said)


def _grid(encoding: Keys, said: Said) -> None:
    kind = encoding.text("otype") or "HashGrid"
    if kind not in ("HashGrid", "Grid", _PROGRESSIVE) or (
        kind == "Grid" and encoding.text("type") not in (None, "Hash")
    ):
        said.refuse(encoding, "otype")
    if encoding.flag("include_xyz") is False:
        said.refuse(encoding, "include_xyz")
    levels = encoding.whole("n_levels")
    said.put("hash.levels", levels, encoding, "n_levels")
    said.put("hash.features_per_level", encoding.whole("n_features_per_level"), encoding, "n_features_per_level")
    said.put("hash.log2_table_size", encoding.whole("log2_hashmap_size"), encoding, "log2_hashmap_size")
    said.put("hash.base_resolution", encoding.whole("base_resolution"), encoding, "base_resolution")
    said.put("hash.per_level_scale", encoding.number("per_level_scale"), encoding, "per_level_scale")
    interpolation = (encoding.text("interpolation") or "Linear").lower()
    if interpolation not in ("linear", "smoothstep"):
        said.refuse(encoding, "interpolation")
    said.put("hash.interpolation", interpolation, encoding, "otype")
    step = said.facts.numbers.get("global_step")
    if kind == _PROGRESSIVE and levels is not None and step is not None:
        first, begin = encoding.whole("start_level") or 0, encoding.whole("start_step") or 0
        every = max(encoding.whole("update_steps") or 1, 1)
        said.put("level_mask", max(min(first + max(step - begin, 0) // every, levels), 1), encoding, "start_level")
        said.note(encoding, "update_steps")
    elif kind != _PROGRESSIVE:
        said.put("level_mask", levels, encoding, "n_levels")


def _network(network: Keys, geometry: Keys, said: Said) -> None:
    if (network.text("otype") or "VanillaMLP") != "VanillaMLP":
        said.refuse(network, "otype")
    if (network.text("output_activation") or "none").lower() != "none":
        said.refuse(network, "output_activation")
    first = said.facts.shape("geometry.network.layers.0.bias") or said.facts.shape("geometry.network.layers.0.weight_v")
    said.agree(network, "n_neurons", first[0] if first else None)
    said.agree(network, "n_hidden_layers", said.facts.hidden_layers("geometry.network.layers."))
    starts_round = network.flag("sphere_init")
    if starts_round is not None:
        said.put("activation", "softplus" if starts_round else "relu", network, "sphere_init")
    _output(geometry, said)


def _output(geometry: Keys, said: Said) -> None:
    """(out + bias), then the activation; the bias counts only beside an activation."""
    name = geometry.text("sdf_activation")
    if name is None:
        return
    bias, factor = geometry.number("sdf_bias") or 0.0, 1.0
    found = _ACTIVATION.fullmatch(name.lower())
    kind, rest = (found[1], found[2]) if found is not None else (None, "?")
    if kind in ("mul", "+", "-") and re.fullmatch(r"[0-9.]{1,12}", rest) and rest.count(".") < 2:
        number = float(rest)
        factor, bias = (number, bias) if kind == "mul" else (1.0, bias + (number if kind == "+" else -number))
    elif name.lower() not in ("none", ""):
        said.refuse(geometry, "sdf_activation")
    if factor != 1.0:
        said.put("output_scale", factor, geometry, "sdf_activation")
    if bias:
        said.put("output_bias", bias, geometry, "sdf_bias")


def _color(texture: Keys, said: Said) -> None:
    """Nothing of it makes the geometry another one: a color of a form that is not known is left out."""
    direction, network = texture.below("dir_encoding_config"), texture.below("mlp_network_config")
    if not isinstance(texture.find(""), dict):
        return
    usual = {
        "name": (*_COLORS, None),
        "color_activation": ("sigmoid", None),
        "dir_encoding_config.otype": ("SphericalHarmonics", None),
        "mlp_network_config.otype": ("FullyFusedMLP", "VanillaMLP", None),
        "mlp_network_config.output_activation": ("none", "None", None),
        "mlp_network_config.activation": ("ReLU", None),
    }
    said.without_color(texture, [key for key, known in usual.items() if texture.text(key) not in known])
    if (inputs := _COLORS.get(texture.text("name") or "")) is not None:
        said.put("color.inputs", inputs, texture, "name")
    else:
        said.put("color.direction_degree", direction.whole("degree"), direction, "degree")
    if network.text("otype") == "FullyFusedMLP":
        said.put("color.hidden_width", network.whole("n_neurons"), network, "n_neurons")


def _radius(keys: Keys, said: Said) -> None:
    """The scene's half edge, which the checkpoint has too."""
    radius = keys.number("model.radius")
    box = said.facts.few("scene_aabb")
    if radius is None or box is None:
        return
    if abs(max(box) - radius) > 1e-5 * radius:
        raise contradiction(f"{keys.file}: model.radius", radius, max(box))
    said.note(keys, "model.radius")
