"""Trainers of hash grids: sdfstudio, nerfstudio, instant-nsr-pl and Neuralangelo."""

from __future__ import annotations

import re

from regnf_core.importing.families.layers import contradiction
from regnf_core.importing.settings.facts import after_scaling, inverse_of, is_similarity, scaled_and_moved
from regnf_core.importing.settings.keys import Keys, malformed
from regnf_core.importing.settings.said import Said

# sdfstudio and nerfstudio: config.yml, a dump of Python objects, of which the keys below ``sdf_field`` count.

_FIELD = "pipeline.model.sdf_field"
_DEGREE = 6
_STEPS_A_LEVEL = 10_000
_BASE = 16
"""Nodes of nerfacto's coarsest level, where releases had no setting for it."""
_OTHER_COLORS = ("use_diffuse_color", "use_specular_tint", "use_reflections", "use_n_dot_v")
"""Each makes the color another function."""


def is_studio(keys: Keys) -> bool:
    """Whether one of the two wrote the file."""
    return isinstance(keys.find(_FIELD), dict) or keys.tag().rpartition(":")[2].startswith("nerfstudio.")


def is_nerfstudio(keys: Keys) -> bool:
    """By the class of the file's root, or by the name that the two give to the same setting."""
    theirs = keys.tag().endswith("nerfstudio.engine.trainer.TrainerConfig")
    return is_studio(keys) and (theirs or keys.has(f"{_FIELD}.features_per_level"))


def studio(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED, SETTINGS_CONTRADICT_TENSORS, FAMILY_NOT_SUPPORTED."""
    field, theirs = keys.below(_FIELD), said.trainer == "nerfstudio"
    if not isinstance(field.find(""), dict):
        raise malformed(f"{keys.file}: {_FIELD} is missing: a model without a signed distance")
    layers = field.whole("num_layers")
    if theirs:
        said.put("family", "nerfstudio_neus_facto", keys, "method_name")
    elif layers is not None:
        variant = "neus_facto_angelo" if layers == 1 else "neus" if layers > 3 else "neus_facto"
        said.put("family", f"sdfstudio_{variant}", field, "num_layers")
    said.agree(field, "num_layers", said.facts.hidden_layers("field.glin"))
    width = said.facts.shape("field.glin0.bias")
    said.agree(field, "hidden_dim", width[0] if width and layers else None)
    _studio_encodings(field, said, theirs)
    if field.flag("inside_outside"):  # begun as a room: positive in the free space that it encloses
        said.put("sign", 1, field, "inside_outside")
    said.values["contraction"] = "linf_grid" if theirs else "none"
    _studio_schedule(keys, field, said)
    said.about_color(lambda: _studio_color(keys.below("pipeline.model"), field, said))
    _studio_frame(keys, said)


def is_radiance(keys: Keys) -> bool:
    """Whether one of the two wrote it of a model without a signed distance: a radiance field, or Gaussian splats."""
    return is_studio(keys) and isinstance(keys.find("pipeline.model"), dict) and not keys.has(_FIELD)


def radiance(keys: Keys, said: Said) -> None:
    """Fill ``said``: of nerfacto, or the frame alone. Raises FieldFormatError (SETTINGS_MALFORMED)."""
    model = keys.below("pipeline.model")
    if said.facts.count("field.mlp_base", ""):
        grid = {"hash.levels": "num_levels", "hash.features_per_level": "features_per_level"}
        grid |= {"hash.log2_table_size": "log2_hashmap_size", "hash.base_resolution": "base_res"}
        said.take(model, Keys.whole, grid | {"hash.top_resolution": "max_res"})
        said.values["hash.base_resolution"] = said.values.get("hash.base_resolution", _BASE)
        said.values["contraction"] = "linf"
        said.choose("contraction", model, "disable_scene_contraction", ("none", "linf"))
        said.values["output_scale"] = 1.0
        said.put("output_scale", model.number("average_init_density"), model, "average_init_density")
    _studio_frame(keys, said)


def _studio_encodings(field: Keys, said: Said, theirs: bool) -> None:
    said.take(field, Keys.flag, {"use_grid": "use_grid_feature"})
    if field.flag("use_grid_feature"):
        said.expect(field, "encoding_type", "hash")
    features, smooth = (
        ("features_per_level", "smoothstep") if theirs else ("hash_features_per_level", "hash_smoothstep")
    )
    grid = {"hash.levels": "num_levels", "hash.features_per_level": features}
    grid |= {"hash.log2_table_size": "log2_hashmap_size", "hash.base_resolution": "base_res"}
    said.take(field, Keys.whole, grid | {"hash.top_resolution": "max_res"})
    said.choose("hash.interpolation", field, smooth, ("smoothstep", "linear"))
    if field.flag("off_axis") and field.flag("use_position_encoding") is not False:
        said.refuse(field, "off_axis")
    if theirs:  # no key of its own: it is always the same
        said.values["positional_encoding.degree"] = _DEGREE
    else:
        said.take(field, Keys.whole, {"positional_encoding.degree": "position_encoding_max_degree"})
    said.take(field, Keys.flag, {"positional_encoding.used": "use_position_encoding"})
    said.values["positional_encoding.two_pi"] = theirs


def _studio_schedule(keys: Keys, field: Keys, said: Said) -> None:
    """The trainer evaluates all levels of a loaded checkpoint, however many its training had opened by then."""
    model = keys.below("pipeline.model")
    step, levels = said.facts.numbers.get("step"), field.whole("num_levels")
    if not model.flag("enable_progressive_hash_encoding") or step is None or levels is None:
        return
    opened = max(step // _STEPS_A_LEVEL + 1, model.whole("level_init") or 0)
    if opened < levels:
        said.warnings.append(
            f"LEVEL_MASK_ASSUMED: at step {step} the training used {opened} of {levels} levels; the trainer "
            f"evaluates all of them after loading, and so does the field; to use only those, give the "
            f"import option level_mask: {opened}"
        )


def _studio_color(model: Keys, field: Keys, said: Said) -> None:
    said.take(model, Keys.flag, {"color.average_appearance": "use_average_appearance_embedding"})
    said.take(field, Keys.number, {"color.padding": "rgb_padding"})
    said.without_color(field, [name for name in _OTHER_COLORS if field.flag(name)])


def _studio_frame(keys: Keys, said: Said) -> None:
    parser = keys.below("pipeline.datamanager.dataparser")
    moved = bool(parser.flag("auto_orient"))
    written = said.documents.named("dataparser_transforms.json")
    if written is not None:
        rows, scale = written.matrix("transform", 3, 4), written.number("scale")
        identity = rows == [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
        if rows is not None and scale is not None and scale > 0 and not (moved and identity):
            said.put("dataset_transform", inverse_of(rows, scale), written, "scale")
        return
    world = said.documents.named("meta_data.json")
    rows = None if world is None else world.matrix("worldtogt", 4, 4)
    moved = moved or bool(parser.flag("center_poses")) or bool(parser.flag("auto_scale_poses"))
    if world is not None and rows is not None and not moved and is_similarity(rows):
        factor = parser.number("scale_factor") or 1.0
        said.put("dataset_transform", after_scaling(rows, 1.0 / factor), world, "worldtogt")


# instant-nsr-pl: parsed.yaml, the configuration after all substitutions, as OmegaConf writes it.

NSR_ENCODING = "model.geometry.xyz_encoding_config"
_NSR_COLORS = {"volume-radiance": None, "volume-color": "features"}
"""What the color's kinds see besides the usual."""
_NSR_COLOR_FORMS = {
    "name": (*_NSR_COLORS, None),
    "color_activation": ("sigmoid", None),
    "dir_encoding_config.otype": ("SphericalHarmonics", None),
    "mlp_network_config.otype": ("FullyFusedMLP", "VanillaMLP", None),
    "mlp_network_config.output_activation": ("none", "None", None),
    "mlp_network_config.activation": ("ReLU", None),
}
_PROGRESSIVE = "ProgressiveBandHashGrid"
_SHIFTED_OR_SCALED = re.compile(r"(mul|[+-])([0-9]{1,12}|[0-9]{0,11}\.[0-9]{1,11}|[0-9]{1,11}\.)")


def instant_nsr_pl(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED, SETTINGS_CONTRADICT_TENSORS, FAMILY_NOT_SUPPORTED."""
    geometry = keys.below("model.geometry")
    network, first = geometry.below("mlp_network_config"), "geometry.network.layers.0"
    said.put("family", "instant_nsr_pl", keys, "model.name")
    _nsr_grid(keys.below(NSR_ENCODING), said)
    said.expect(network, "otype", "VanillaMLP")
    if (network.text("output_activation") or "none").lower() != "none":
        said.refuse(network, "output_activation")
    rows = said.facts.shape(f"{first}.bias") or said.facts.shape(f"{first}.weight_v")
    said.agree(network, "n_neurons", rows[0] if rows else None)
    said.agree(network, "n_hidden_layers", said.facts.hidden_layers("geometry.network.layers."))
    said.choose("activation", network, "sphere_init", ("softplus", "relu"))
    _nsr_output(geometry, said)
    said.about_color(lambda: _nsr_color(keys.below("model.texture"), said))
    radius, box = keys.number("model.radius"), said.facts.few("scene_aabb")
    if radius is not None and box is not None:  # the scene's half edge, which the checkpoint has too
        if abs(max(box) - radius) > 1e-5 * radius:
            raise contradiction(f"{keys.file}: model.radius", radius, max(box))
        said.note(keys, "model.radius")


def _nsr_grid(encoding: Keys, said: Said) -> None:
    kind = encoding.text("otype") or "HashGrid"
    said.expect(encoding, "otype", "HashGrid", "Grid", _PROGRESSIVE)
    if kind == "Grid" and encoding.text("type") not in (None, "Hash"):
        said.refuse(encoding, "otype")
    if encoding.flag("include_xyz") is False:
        said.refuse(encoding, "include_xyz")
    grid = {"hash.levels": "n_levels", "hash.features_per_level": "n_features_per_level"}
    grid |= {"hash.log2_table_size": "log2_hashmap_size", "hash.base_resolution": "base_resolution"}
    said.take(encoding, Keys.whole, grid)
    said.take(encoding, Keys.number, {"hash.per_level_scale": "per_level_scale"})
    interpolation = (encoding.text("interpolation") or "Linear").lower()
    if interpolation not in ("linear", "smoothstep"):
        said.refuse(encoding, "interpolation")
    said.put("hash.interpolation", interpolation, encoding, "otype")
    step, levels = said.facts.numbers.get("global_step"), encoding.whole("n_levels")
    if kind == _PROGRESSIVE and levels is not None and step is not None:
        first, begin = encoding.whole("start_level") or 0, encoding.whole("start_step") or 0
        every = max(encoding.whole("update_steps") or 1, 1)
        said.put("level_mask", max(min(first + max(step - begin, 0) // every, levels), 1), encoding, "start_level")
        said.note(encoding, "update_steps")
    elif kind != _PROGRESSIVE:
        said.put("level_mask", levels, encoding, "n_levels")


def _nsr_output(geometry: Keys, said: Said) -> None:
    """(out + bias), then the activation; the bias counts only beside an activation."""
    name = geometry.text("sdf_activation")
    if name is None:
        return
    bias, factor = geometry.number("sdf_bias") or 0.0, 1.0
    if (found := _SHIFTED_OR_SCALED.fullmatch(name.lower())) is not None:
        kind, number = found[1], float(found[2])
        factor, bias = (number, bias) if kind == "mul" else (1.0, bias + (number if kind == "+" else -number))
    elif name.lower() not in ("none", ""):
        said.refuse(geometry, "sdf_activation")
    if factor != 1.0:
        said.put("output_scale", factor, geometry, "sdf_activation")
    if bias:
        said.put("output_bias", bias, geometry, "sdf_bias")


def _nsr_color(texture: Keys, said: Said) -> None:
    if not isinstance(texture.find(""), dict):
        return
    said.without_color(texture, [key for key, known in _NSR_COLOR_FORMS.items() if texture.text(key) not in known])
    if (inputs := _NSR_COLORS.get(texture.text("name") or "")) is not None:
        said.put("color.inputs", inputs, texture, "name")
    else:
        said.take(texture.below("dir_encoding_config"), Keys.whole, {"color.direction_degree": "degree"})
    if texture.text("mlp_network_config.otype") == "FullyFusedMLP":
        said.take(texture.below("mlp_network_config"), Keys.whole, {"color.hidden_width": "n_neurons"})


# Neuralangelo: config.yaml of a run, of which ``model.object.sdf`` counts, and transforms.json for the frame.

ANGELO_ENCODING = "model.object.sdf.encoding"
_WARM_UP = 5000


def neuralangelo(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED, SETTINGS_CONTRADICT_TENSORS, FAMILY_NOT_SUPPORTED."""
    network, encoding = keys.below("model.object.sdf.mlp"), keys.below(ANGELO_ENCODING)
    said.put("family", "neuralangelo", encoding, "type")
    said.expect(encoding, "type", "hashgrid")
    said.expect(network, "activ", "softplus")
    if network.number("activ_params.beta") not in (None, 100.0):
        said.refuse(network, "activ_params.beta")
    if network.find("skip"):
        said.refuse(network, "skip")
    _angelo_grid(encoding, said)
    _angelo_open_levels(keys, encoding, said)
    first = said.facts.shape("neural_sdf.mlp.linears.0.bias")
    said.agree(network, "hidden_dim", first[0] if first else None)
    said.agree(network, "num_layers", said.facts.hidden_layers("neural_sdf.mlp.linears."))
    _angelo_frame(keys, said)


def _angelo_grid(encoding: Keys, said: Said) -> None:
    grid = encoding.below("hashgrid")
    said.take(encoding, Keys.whole, {"hash.levels": "levels"})
    said.take(grid, Keys.whole, {"hash.features_per_level": "dim", "hash.log2_table_size": "dict_size"})
    for entry, key in (("hash.base_resolution", "min_logres"), ("hash.top_resolution", "max_logres")):
        exponent = grid.number(key)
        if exponent is not None and not 0 < exponent <= 20:
            raise grid.fault(key, "an exponent of 2 from 0 to 20")
        said.put(entry, None if exponent is None else round(2.0**exponent), grid, key)
    reach = grid.numbers("range")
    if reach is not None:
        if len(reach) != 2 or not 0 < reach[1] == -reach[0]:
            said.refuse(grid, "range")
        said.put("hash.radius", reach[1], grid, "range")
    said.values["hash.interpolation"] = "linear"


def _angelo_open_levels(keys: Keys, encoding: Keys, said: Said) -> None:
    levels, iteration = encoding.whole("levels"), said.facts.numbers.get("iteration")
    schedule = encoding.below("coarse2fine")
    if levels is None:
        return
    if not schedule.flag("enabled"):
        said.put("level_mask", levels, encoding, "levels")
    elif iteration is not None:
        every = max(schedule.whole("step") or _WARM_UP, 1)
        begin = keys.whole("optim.sched.warm_up_end")
        by_step = min(levels, max((iteration - (_WARM_UP if begin is None else begin)) // every, 1))
        opened = min(max(schedule.whole("init_active_level") or 1, by_step), levels)
        said.put("level_mask", opened, schedule, "init_active_level")
        said.note(schedule, "step")


def _angelo_frame(keys: Keys, said: Said) -> None:
    sphere = said.documents.named("transforms.json")
    if sphere is None:
        return
    center, radius = sphere.numbers("sphere_center", 3), sphere.number("sphere_radius")
    if center is None or len(center) != 3 or radius is None or not radius > 0:
        return
    shift, factor = keys.numbers("data.readjust.center", 3) or [0.0] * 3, keys.number("data.readjust.scale") or 1.0
    moved = [value + more for value, more in zip(center, shift, strict=False)]
    said.put("dataset_transform", scaled_and_moved(radius * factor, moved), sphere, "sphere_radius")
