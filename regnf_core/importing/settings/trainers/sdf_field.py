"""sdfstudio and nerfstudio: config.yml, a dump of Python objects, of which the keys below ``sdf_field`` count."""

from __future__ import annotations

from regnf_core.importing.settings.documents import Documents, mappings
from regnf_core.importing.settings.facts import after_scaling, inverse_of, is_similarity
from regnf_core.importing.settings.keys import Keys, malformed
from regnf_core.importing.settings.said import Said

_FIELD = "pipeline.model.sdf_field"
_PREFIX = "glin"
_DEGREE = 6
_STEPS_A_LEVEL = 10_000
_OTHER_COLORS = ("use_diffuse_color", "use_specular_tint", "use_reflections", "use_n_dot_v")
"""Each makes the color another function."""


def main_file(documents: Documents) -> Keys | None:
    """The file that is one of theirs."""
    for keys in mappings(documents):
        if isinstance(keys.find(_FIELD), dict) or keys.tag().rpartition(":")[2].startswith("nerfstudio."):
            return keys
    return None


def trainer_of(keys: Keys) -> str:
    """Which of the two wrote the file: the class of its root, or the name that the two give to the same setting."""
    if keys.tag().endswith("nerfstudio.engine.trainer.TrainerConfig"):
        return "nerfstudio"
    return "nerfstudio" if keys.has(f"{_FIELD}.features_per_level") else "sdfstudio"


def translate(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED, SETTINGS_CONTRADICT_TENSORS, FAMILY_NOT_SUPPORTED."""
    field = keys.below(_FIELD)
    if not isinstance(field.find(""), dict):
        raise malformed(f"{keys.file}: {_FIELD} is missing: a model without a signed distance")
    theirs = said.trainer == "nerfstudio"
    layers = field.whole("num_layers")
    if theirs:
        said.put("family", "nerfstudio_neus_facto", keys, "method_name")
    elif layers is not None:
        said.put("family", _variant(layers), field, "num_layers")
    said.agree(field, "num_layers", said.facts.hidden_layers("field.glin"))
    width = said.facts.shape("field.glin0.bias")
    said.agree(field, "hidden_dim", width[0] if width and layers else None)
    _grid(
        field,
        said,
        "features_per_level" if theirs else "hash_features_per_level",
        "smoothstep" if theirs else "hash_smoothstep",
    )
    _encoding(field, said, theirs)
    if field.flag("inside_outside"):  # begun as a room: positive in the free space that it encloses
        said.put("sign", 1, field, "inside_outside")
    said.values["contraction"] = "linf_grid" if theirs else "none"
    _schedule(keys, field, said)
    said.about_color(lambda: _color(keys.below("pipeline.model"), field, said))
    _frame(keys, said)


def _variant(layers: int) -> str:
    if layers == 1:
        return "sdfstudio_neus_facto_angelo"
    return "sdfstudio_neus" if layers > 3 else "sdfstudio_neus_facto"


def _grid(field: Keys, said: Said, features: str, smooth: str) -> None:
    said.put("use_grid", field.flag("use_grid_feature"), field, "use_grid_feature")
    if field.flag("use_grid_feature") and (field.text("encoding_type") or "hash") != "hash":
        said.refuse(field, "encoding_type")
    said.put("hash.levels", field.whole("num_levels"), field, "num_levels")
    said.put("hash.features_per_level", field.whole(features), field, features)
    said.put("hash.log2_table_size", field.whole("log2_hashmap_size"), field, "log2_hashmap_size")
    said.put("hash.base_resolution", field.whole("base_res"), field, "base_res")
    said.put("hash.top_resolution", field.whole("max_res"), field, "max_res")
    is_smooth = field.flag(smooth)
    if is_smooth is not None:
        said.put("hash.interpolation", "smoothstep" if is_smooth else "linear", field, smooth)


def _encoding(field: Keys, said: Said, theirs: bool) -> None:
    if field.flag("off_axis") and field.flag("use_position_encoding") is not False:
        said.refuse(field, "off_axis")
    if theirs:  # no key of its own: it is always the same
        said.values["positional_encoding.degree"] = _DEGREE
    else:
        said.put(
            "positional_encoding.degree",
            field.whole("position_encoding_max_degree"),
            field,
            "position_encoding_max_degree",
        )
    said.put("positional_encoding.used", field.flag("use_position_encoding"), field, "use_position_encoding")
    said.values["positional_encoding.two_pi"] = theirs


def _schedule(keys: Keys, field: Keys, said: Said) -> None:
    """The trainer evaluates all levels of a loaded checkpoint, however many its training had opened by then."""
    model = keys.below("pipeline.model")
    step, levels = said.facts.numbers.get("step"), field.whole("num_levels")
    if not model.flag("enable_progressive_hash_encoding") or step is None or levels is None:
        return
    opened = max(step // _STEPS_A_LEVEL + 1, model.whole("level_init") or 0)
    if opened < levels:
        said.warnings.append(
            f"LEVEL_MASK_ASSUMED: by step {step} training had opened {opened} of {levels} levels; the trainer evaluates"
            f" all of them after loading, and so does the field; say level_mask {opened} for the other"
        )


def _color(model: Keys, field: Keys, said: Said) -> None:
    """Nothing of it makes the geometry another one: a color of a form that is not known is left out."""
    key = "use_average_appearance_embedding"
    said.put("color.average_appearance", model.flag(key), model, key)
    said.put("color.padding", field.number("rgb_padding"), field, "rgb_padding")
    said.without_color(field, [name for name in _OTHER_COLORS if field.flag(name)])


def _frame(keys: Keys, said: Said) -> None:
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
