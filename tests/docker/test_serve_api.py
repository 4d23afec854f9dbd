"""What the service image starts: it refuses to serve strangers, and serves otherwise, until it is told to stop."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import httpx

from tests.docker.files import ROOT
from tests.redis_server import private_redis
from tests.worker.bench import eventually

SCRIPT = ROOT / "docker" / "serve_api.py"


def environment(folder: Path, **settings: str) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("REGNF_")}
    named = {f"REGNF_{name.upper()}": value for name, value in settings.items()}
    return kept | {"PYTHONPATH": str(ROOT), "REGNF_STATE_DIR": str(folder)} | named


def answered(address: str, process: subprocess.Popen[bytes]) -> bool:
    assert process.poll() is None, "the server has ended"
    with suppress(httpx.TransportError):
        return httpx.get(address).status_code == 200
    return False


def test_refuses_to_serve_strangers(tmp_path: Path) -> None:
    run = subprocess.run(
        [sys.executable, SCRIPT],
        env=environment(tmp_path, host="0.0.0.0", port="0", redis_url="unix:///nowhere/socket"),
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 2
    assert run.stderr.startswith("UNAUTHENTICATED_PUBLIC_BIND: ")


def test_serves_whoever_has_a_token_until_told_to_stop(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    with private_redis() as url:
        settings = environment(tmp_path, host="127.0.0.1", port=str(port), redis_url=url, api_tokens='["open-sesame"]')
        process = subprocess.Popen([sys.executable, SCRIPT], env=settings)
        try:
            eventually(lambda: answered(f"http://127.0.0.1:{port}/healthz", process), "the first answer", 30)
            for headers, status in (({}, 401), ({"Authorization": "Bearer open-sesame"}, 200)):
                assert httpx.get(f"http://127.0.0.1:{port}/jobs", headers=headers).status_code == status
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(timeout=30)
