"""nginx with the configuration of compose file and chart, before a real service."""

from __future__ import annotations

import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx
import pytest

from tests.contract.live import Live, eventually, live_service

FOLDER = Path(__file__).resolve().parents[2] / "deploy/helm/regnf/proxy"
OF_ONE_ADDRESS = 5
pytestmark = pytest.mark.skipif(shutil.which("nginx") is None, reason="nginx is not installed")


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port: int = probe.getsockname()[1]
        return port


def taken(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1).close()
    except OSError:
        return False
    return True


@contextmanager
def nginx(folder: Path, live: Live, certificate: Path) -> Iterator[int]:
    """The port of a proxy before the service. Only addresses and times are other than in a container."""
    port, changed = free_port(), folder / "nginx"
    changed.mkdir()
    replaced = {
        "/tmp/": f"{changed}/", "/etc/regnf-tls": str(certificate), "/etc/regnf/": f"{changed}/",
        "api:8080": f"127.0.0.1:{live.port}", "listen 8000": f"listen 127.0.0.1:{port}",
        "client_header_timeout 10s": "client_header_timeout 1s", "client_body_timeout 30s": "client_body_timeout 1s",
        "addresses 256": f"addresses {OF_ONE_ADDRESS}",
    }  # fmt: skip
    for source in FOLDER.iterdir():
        text = source.read_text()
        for before, after in replaced.items():
            text = text.replace(before, after)
        (changed / source.name).write_text(text)
    process = subprocess.Popen(["sh", str(changed / "start.sh")])
    try:
        eventually(lambda: taken(port), "nginx")
        yield port
    finally:
        process.terminate()
        process.wait(20)


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    folder, settings = tmp_path_factory.mktemp("proxied"), {"behind_proxy": True, "api_tokens": '["key"]'}
    with live_service(folder, with_worker=False, **settings) as started:
        yield started


@pytest.fixture(scope="module")
def proxy(live: Live, tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    folder = tmp_path_factory.mktemp("clear")
    with nginx(folder, live, folder / "none") as port:
        yield port


def test_requests_and_origins_pass(proxy: int) -> None:
    """The page's origin has the proxy's port: the API must be told the same."""
    headers = {"Authorization": "Bearer key", "Origin": f"http://localhost:{proxy}"}
    with httpx.Client(base_url=f"http://localhost:{proxy}", headers=headers) as client:
        assert client.get("/jobs").status_code == 200
        assert client.post("/register", json={}).status_code == 422
        assert client.get("/jobs", headers={"Origin": "http://evil.example"}).json()["reason"] == "ORIGIN_NOT_ALLOWED"
        assert len(client.get("/static/vendor/three.bundle.min.js").content) > 100_000


@pytest.mark.parametrize(
    "begun", ["GET / HTTP/1.1\r\n", "PUT /fields/0 HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\nab"]
)
def test_slow_clients_are_cut_off(proxy: int, begun: str) -> None:
    with socket.create_connection(("127.0.0.1", proxy), timeout=30) as slow:
        slow.sendall(begun.encode())
        assert ended(slow)


def ended(connection: socket.socket) -> bool:
    """Whether the other side closes the connection before its time-out."""
    try:
        while connection.recv(4096):
            pass
    except ConnectionResetError:
        return True
    except TimeoutError:
        return False
    return True


def test_a_refusal_reaches_a_client_that_goes_on_sending(proxy: int) -> None:
    """The API stops reading, and the proxy passes its answer on."""
    headers = {"Authorization": "Bearer key"}
    with httpx.Client(base_url=f"http://localhost:{proxy}", headers=headers) as client:
        answers = [client.put(f"/fields/{'0' * 64}", content=b"\x89PNG" + bytes(8 << 20)) for _ in range(5)]
    assert [one.json()["reason"] for one in answers] == ["FIELD_NOT_RECOGNIZED"] * 5


def test_one_address_has_so_many_connections(proxy: int) -> None:
    head = b"PUT /fields/0 HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n"

    def beside_as_many() -> set[int]:
        with ExitStack() as stack:
            for _ in range(OF_ONE_ADDRESS):
                one = stack.enter_context(socket.create_connection(("127.0.0.1", proxy), timeout=30))
                one.sendall(head)
            return {httpx.get(f"http://localhost:{proxy}/healthz").status_code for _ in range(3)}

    # on a busy machine those that send nothing may be cut off before the others ask
    assert eventually(lambda: beside_as_many() == {429}, "the refusals", 20)


def test_tls_where_there_is_a_certificate(live: Live, tmp_path: Path) -> None:
    made = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=localhost", "-days", "1"]
    files = ["-keyout", str(tmp_path / "tls.key"), "-out", str(tmp_path / "tls.crt")]
    subprocess.run([*made, *files], check=True, capture_output=True)
    with nginx(tmp_path, live, tmp_path) as port:
        assert httpx.get(f"https://localhost:{port}/healthz", verify=False).status_code == 200
        assert httpx.get(f"http://localhost:{port}/healthz").status_code == 400
