"""The library with a real service and its worker: an entry's symmetry is found, and its field carried elsewhere."""

from __future__ import annotations

from pathlib import Path

from regnf_client import Client
from tests.contract.live import Live, eventually
from tests.live_stack import DATA, LIVE

pytestmark = LIVE


def test_a_worker_finds_an_entrys_symmetry(live_stack: Live, tmp_path: Path) -> None:
    with Client(live_stack.address) as client:
        made = client.library.add("a dining chair", DATA / "dining-chair.safetensors", ["seat"])
        found = eventually(lambda: client.library.get(made.name).symmetry, "the symmetry of the entry", 120)
        assert found == {"order": 1, "axis": None, "continuous": False}
        assert client.library.get(made.name).symmetry_source == "detected"
        carried = client.library.download(made.name, tmp_path / "chair.safetensors")
        assert carried.read_bytes()[8:9] == b"{"
        client.library.remove(made.name)
