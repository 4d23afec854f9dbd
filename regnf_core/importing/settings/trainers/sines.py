"""Networks of sines: the frequency factor in a YAML or JSON of any trainer, hydra's among them."""

from __future__ import annotations

from regnf_core.importing.settings.documents import Documents, mappings
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.settings.said import Said

_PARTS = ("", "model.", "network.", "net.", "decoder.", "model.params.")
_FIRST, _HIDDEN = ("first_omega_0", "w0_initial"), ("hidden_omega_0", "w0", "omega_0", "omega", "omega0")
_NAMES = (*_FIRST, *_HIDDEN)


def main_file(documents: Documents) -> Keys | None:
    """The first file that names a frequency."""
    for keys in mappings(documents):
        if any(keys.has(f"{part}{name}") for part in _PARTS for name in _NAMES):
            return keys
    return None


def translate(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED."""
    part = next(part for part in _PARTS if any(keys.has(f"{part}{name}") for name in _NAMES))
    for entry, names in (("first_activation_scale", _FIRST), ("activation_scale", _HIDDEN)):
        name = next((name for name in names if keys.has(f"{part}{name}")), None)
        if name is not None:
            said.put(entry, keys.number(f"{part}{name}"), keys, f"{part}{name}")
