"""Tokens and webhook secrets are in no process' arguments, no log and no answer, and workers are not given them."""

from __future__ import annotations

import base64
import json
import os
from pathlib import Path

import httpx

from regnf_cli.demo import running_service
from tests.processes import command_of, descendants_of

TOKEN, FILED = "token-of-alice-1f9c", "token-of-bob-77aa"
SECRET = base64.b64encode(b"a webhook secret, 26 bytes").decode()


def test_secrets_stay_where_they_belong(tmp_path: Path) -> None:
    file = tmp_path / "tokens"
    file.write_text(f"alice:{TOKEN}\nbob:{FILED}\n")
    state = tmp_path / "state"
    settings = {
        "api_tokens": f"@{file}",
        "webhook_secrets": json.dumps([f"alice:whsec_{SECRET}"]),
        "webhook_hosts": '["http://127.0.0.1:1"]',
        "log_format": "json",
    }
    with running_service(state, **settings) as address, httpx.Client(base_url=address, timeout=30) as client:
        texts = []
        for token in (TOKEN, FILED, "wrong"):
            headers = {"Authorization": f"Bearer {token}"}
            for method, path in (("GET", "/jobs"), ("POST", "/register"), ("PUT", "/fields/x"), ("GET", "/nowhere")):
                texts.append(client.request(method, path, headers=headers, content=b"x").text)
        assert client.get("/jobs", headers={"Authorization": f"Bearer {FILED}"}).status_code == 200
        running = {pid: command_of(pid) for pid in descendants_of(os.getpid())}
        texts += [" ".join(command) for command in running.values()]
        workers = [pid for pid, command in running.items() if "regnf_worker.main" in command]
        assert workers
        environments = [(Path("/proc") / str(pid) / "environ").read_bytes().decode() for pid in workers]
    texts += [path.read_text(errors="replace") for path in state.rglob("*.log")]
    assert any('"caller": "bob"' in text for text in texts), "the log was looked at"
    for secret in (TOKEN, FILED, SECRET):
        assert not [text for text in texts + environments if secret in text]
