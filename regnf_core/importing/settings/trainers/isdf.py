"""iSDF: the JSON of a run, of which ``model`` counts: its two factors are in no checkpoint."""

from __future__ import annotations

from regnf_core.importing.settings.documents import Documents, mappings
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.settings.said import Said


def main_file(documents: Documents) -> Keys | None:
    """The file that is one of theirs."""
    named = ("model.scale_output", "model.embedding")
    return next((keys for keys in mappings(documents) if all(map(keys.has, named))), None)


def translate(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED, SETTINGS_CONTRADICT_TENSORS, FAMILY_NOT_SUPPORTED."""
    model = keys.below("model")
    said.put("family", "isdf", model, "hidden_feature_size")
    if model.find("embedding.gauss_embed"):
        said.refuse(model, "embedding.gauss_embed")
    for entry, key in (("input_scale", "embedding.scale_input"), ("output_scale", "scale_output")):
        factor = model.number(key)
        if factor is not None and factor <= 0:
            raise model.fault(key, "a positive number")
        said.put(entry, factor, model, key)
    first = said.facts.shape("in_layer.0.weight")
    said.agree(model, "hidden_feature_size", first[0] if first else None)
