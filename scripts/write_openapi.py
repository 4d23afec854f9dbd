"""Write openapi.yaml from the application. Run it whenever the contract changes; a test compares the two.

python scripts/write_openapi.py
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from regnf_service.http.contract import contract_yaml
from regnf_service.server import create_app
from regnf_state.settings import Settings

TARGET = Path(__file__).resolve().parents[1] / "openapi.yaml"


def current_contract() -> str:
    """The contract of the application as it is now."""
    with TemporaryDirectory() as folder:
        # nothing connects to Redis before the first request
        settings = Settings(state_dir=Path(folder), redis_url=f"unix://{folder}/none", api_tokens=frozenset())
        return contract_yaml(create_app(settings))


if __name__ == "__main__":
    TARGET.write_text(current_contract(), encoding="utf-8")
    print(f"wrote {TARGET.name}")
