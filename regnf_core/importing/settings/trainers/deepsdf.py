"""DeepSDF: specs.json, the shapes' latent codes, and how a shape was scaled into the unit sphere."""

from __future__ import annotations

from regnf_core.errors import FieldFormatError
from regnf_core.importing.families.layers import contradiction
from regnf_core.importing.settings.documents import Documents, mappings
from regnf_core.importing.settings.facts import scaled_and_moved
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.settings.said import Said

_NETWORK = "NetworkSpecs"
_HIDDEN = "lin0.bias"


def main_file(documents: Documents) -> Keys | None:
    """The file that is one of theirs."""
    return next((k for k in mappings(documents) if k.has("CodeLength") and isinstance(k.find(_NETWORK), dict)), None)


def translate(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED, SETTINGS_CONTRADICT_TENSORS, FAMILY_NOT_SUPPORTED."""
    network = keys.below(_NETWORK)
    said.put("family", "deepsdf", keys, "NetworkArch")
    if keys.text("NetworkArch") not in (None, "deep_sdf_decoder"):
        said.refuse(keys, "NetworkArch")
    twice = network.flag("use_tanh")
    if twice is not None:
        said.put("output_tanh", 2 if twice else 1, network, "use_tanh")
    _agree(keys, network, said)
    _scaling(said)


def _agree(keys: Keys, network: Keys, said: Said) -> None:
    """What the shapes of the layers show."""
    first = said.facts.shape("lin0.weight_v") or said.facts.shape("lin0.weight")
    if first is None or len(first) != 2:
        return
    said.agree(keys, "CodeLength", first[1] - 3)
    dims = network.wholes("dims")
    layers = said.facts.count("lin", ".bias")
    if dims is not None:
        if len(dims) != layers - 1:
            raise contradiction(f"{keys.file}: NetworkSpecs.dims", f"{len(dims)} hidden layers", layers - 1)
        narrower = 3 if network.flag("xyz_in_all") and 1 not in (network.wholes("latent_in") or []) else 0
        if 1 not in (network.wholes("latent_in") or []) and dims[0] - narrower != first[0]:
            raise contradiction(f"{keys.file}: NetworkSpecs.dims.0", dims[0] - narrower, first[0])
        said.note(network, "dims")
    _agree_on_columns(keys, network, said, layers, first[1])


def _agree_on_columns(keys: Keys, network: Keys, said: Said, layers: int, width: int) -> None:
    """Layers that see the whole input once more, and layers that see the position."""
    whole = network.wholes("latent_in")
    rows = [said.facts.shape(f"lin{i}.bias") for i in range(layers)]
    columns = [said.facts.shape(f"lin{i}.weight_v") or said.facts.shape(f"lin{i}.weight") for i in range(layers)]
    if whole is None or not all(rows) or not all(columns):
        return
    extra = [(c[1] - r[0]) for r, c in zip(rows, columns[1:], strict=False) if r and c and len(c) == 2]
    found = [i + 1 for i, more in enumerate(extra) if more == width]
    expected = sorted({i for i in whole if 0 < i < layers})
    if found != expected:
        raise contradiction(f"{keys.file}: NetworkSpecs.latent_in", expected, found)
    said.note(network, "latent_in")
    seeing = any(more == 3 != width for more in extra)
    if network.flag("xyz_in_all") is not None and bool(network.flag("xyz_in_all")) != seeing and layers > 2:
        raise contradiction(f"{keys.file}: NetworkSpecs.xyz_in_all", network.flag("xyz_in_all"), seeing)


def _scaling(said: Said) -> None:
    """x_field = (x + offset) scale."""
    for name, arrays in said.documents.arrays:
        if "offset" in arrays and "scale" in arrays:
            offset, scale = arrays.numbers("offset").ravel().tolist(), arrays.numbers("scale").ravel().tolist()
            if len(offset) != 3 or len(scale) != 1 or not scale[0] > 0:
                message = f"{name}: offset and scale are not three numbers and a positive one"
                raise FieldFormatError(message, reason="SETTINGS_MALFORMED")
            said.values["dataset_transform"] = scaled_and_moved(1.0 / scale[0], [-value for value in offset])
            said.used.setdefault(name, []).append("offset and scale")
