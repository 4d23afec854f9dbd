"""NeuS: the .conf file of a run, of which ``model.sdf_network`` counts, and the cameras' file for the frame."""

from __future__ import annotations

from regnf_core.importing.settings.documents import Documents, mappings, optional_arrays
from regnf_core.importing.settings.facts import is_similarity
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.settings.said import Said
from regnf_core.importing.settings.trainers.skips import agree_on_skips

_NETWORK = "model.sdf_network"
_COLOR = "model.rendering_network"
_MODES = {"idr": "all", "no_view_dir": "no_direction", "no_normal": "no_gradient"}


def main_file(documents: Documents) -> Keys | None:
    """The file that is one of theirs."""
    return next((keys for keys in mappings(documents) if isinstance(keys.find(_NETWORK), dict)), None)


def translate(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED, SETTINGS_CONTRADICT_TENSORS, FAMILY_NOT_SUPPORTED."""
    network = keys.below(_NETWORK)
    said.put("family", "neus", network, "d_hidden")
    if network.whole("d_in") not in (None, 3):
        said.refuse(network, "d_in")
    said.put("positional_encoding.degree", network.whole("multires"), network, "multires")
    scale = network.number("scale")
    if scale is not None and scale <= 0:
        raise network.fault("scale", "a positive number")
    if scale is not None:
        said.put("input_scale", scale, network, "scale")
        said.put("output_scale", 1.0 / scale, network, "scale")
    said.agree(network, "n_layers", said.facts.hidden_layers("sdf_network_fine.lin"))
    first = said.facts.shape("sdf_network_fine.lin0.bias")
    said.agree(network, "d_hidden", first[0] if first else None)
    agree_on_skips(network, "skip_in", "sdf_network_fine.lin", said)
    said.about_color(lambda: _color(keys.below(_COLOR), said))
    frame = optional_arrays(said.documents, "scale_mat_0")
    if frame is not None and is_similarity(frame[1]):
        said.values["dataset_transform"] = frame[1]
        said.used.setdefault(frame[0], []).append("scale_mat_0")


def _color(network: Keys, said: Said) -> None:
    """Nothing of it makes the geometry another one."""
    mode, squeezed = network.text("mode"), network.flag("squeeze_out")
    if mode is not None and mode not in _MODES:
        said.without_color(network, ["mode"])
    elif mode is not None:
        said.put("color.inputs", _MODES[mode], network, "mode")
    said.put("color.direction_degree", network.whole("multires_view"), network, "multires_view")
    if squeezed is not None:
        said.put("color.output", "sigmoid" if squeezed else "linear", network, "squeeze_out")
