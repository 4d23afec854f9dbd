"""IDR, VolSDF and MonoSDF: the .conf file of a run, of which ``model.implicit_network`` counts."""

from __future__ import annotations

from regnf_core.importing.families.layers import contradiction
from regnf_core.importing.settings.documents import Documents, mappings
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.settings.said import Said
from regnf_core.importing.settings.trainers.skips import agree_on_skips

_NETWORK = "model.implicit_network"
_SPHERES = ("model.scene_bounding_sphere", "model.ray_tracer.object_bounding_sphere", "model.object_bounding_sphere")


def main_file(documents: Documents) -> Keys | None:
    """The file that is one of theirs."""
    return next((keys for keys in mappings(documents) if isinstance(keys.find(_NETWORK), dict)), None)


def translate(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED, SETTINGS_CONTRADICT_TENSORS."""
    network = keys.below(_NETWORK)
    if network.whole("d_in") not in (None, 3):
        said.refuse(network, "d_in")
    said.put("positional_encoding.degree", network.whole("multires"), network, "multires")
    if network.flag("inside_outside"):  # begun as a room: positive in the free space that it encloses
        said.put("sign", 1, network, "inside_outside")
    dims, prefix = network.wholes("dims"), "implicit_network.lin"
    layers = said.facts.count(prefix, ".bias")
    if dims is not None and layers:
        if len(dims) != layers - 1:
            raise contradiction(f"{keys.file}: {_NETWORK}.dims", f"{len(dims)} hidden layers", layers - 1)
        said.note(network, "dims")
    agree_on_skips(network, "skip_in", prefix, said)
    for path in _SPHERES:
        radius = keys.number(path)
        if radius is not None and radius > 0:
            said.put("bounds", [[-radius] * 3, [radius] * 3], keys, path)
            break
