"""Arguments, folders and addresses that a new user gives by mistake."""

# ruff: noqa: E501 -- a mistake is one line of a table
from __future__ import annotations

import json
import os
import socket
from pathlib import Path

import pytest

from tests.cli.conftest import Answers, Run, Serve, field, service, without_worker
from tests.mistakes.case import Case, parametrized

REGISTER = ["register", "room.safetensors", "chair.safetensors", "--detection", "box.json"]
HELP = "--help` lists"
CASES = [
    Case("unknown command", "USAGE", 2, "regster", "No such command", "register", ["regster"]),
    Case("unknown option", "USAGE", 2, "--detectin", "No such option", "--detection", ["register", "--detectin", "x"]),
    Case("option by its old name", "USAGE", 2, "--truth", "No such option", "Did you mean --ground-truth", [*REGISTER, "--truth", "box.json"]),
    Case("no detection", "USAGE", 2, "--detection", "Missing option", "regnf register " + HELP, REGISTER[:3]),
    Case("no object", "USAGE", 2, "(?i)object", "Missing argument", "regnf register " + HELP, [*REGISTER[:2], *REGISTER[3:]]),
    Case("negative seed", "USAGE", 2, "--seed", "greater than or equal to 0", "regnf register " + HELP, [*REGISTER, "--seed=-1"]),
    Case("seed of letters", "USAGE", 2, "--seed", "integer", HELP, [*REGISTER, "--seed", "abc"]),
    Case("typo in the preset", "USAGE", 2, "'papr'", "not one of", "Did you mean paper", [*REGISTER, "--preset", "papr"]),
    Case("JSON for a file", "FILE_NOT_FOUND", 2, r'\{"min"', "no such file", "Write the JSON into a file", [*REGISTER[:4], '{"min": [0, 0, 0]}']),
    Case("detection missing", "FILE_NOT_FOUND", 2, "bx.json", "no such file", "Did you mean box.json", [*REGISTER[:4], "bx.json"]),
    Case("detection a folder", "FILE_IS_FOLDER", 2, "nothing", "expected a file", "Give a file", [*REGISTER[:4], "nothing"]),
    Case("detection a field", "MALFORMED_JSON", 2, "chair.safetensors", "text in UTF-8", "JSON is expected", [*REGISTER[:4], "chair.safetensors"]),
    Case("output a file", "FILE_IS_NO_FOLDER", 2, "box.json", "expected a folder", "another folder", [*REGISTER, "--output", "box.json"]),
    Case("recording of another format", "INVALID_OPTIONS", 2, "chair.bin", ".rrd", "", [*REGISTER, "--recording", "chair.bin"]),
    Case("recording a folder", "FILE_IS_FOLDER", 2, "folder.rrd", "", "", [*REGISTER, "--recording", "folder.rrd"], lambda folder: (folder / "folder.rrd").mkdir()),
    Case("recording below a file", "FILE_IS_NO_FOLDER", 2, "box.json", "", "", [*REGISTER, "--recording", "box.json/chair.rrd"]),
    Case("recording of a service's job", "INVALID_OPTIONS", 2, "--recording", "", "", [*REGISTER, "--recording", "chair.rrd", "--server", "http://127.0.0.1:1"]),
    Case("output below a file", "FILE_IS_NO_FOLDER", 2, "box.json", "expected a folder", "another folder", [*REGISTER, "--output", "box.json/out"]),
    Case("truth without a transform", "INVALID_TRANSFORM", 2, "box.json", "T_object_scene", "Write", [*REGISTER, "--ground-truth", "box.json"]),
    Case("library empty", "LIBRARY_EMPTY", 2, "nothing", "expected regnf field files", "Give the folder", ["search", "room.safetensors", "nothing", *REGISTER[3:]]),
    Case("library missing", "FILE_NOT_FOUND", 2, "nowhere", "no such file", "Check the path", ["search", "room.safetensors", "nowhere", *REGISTER[3:]]),
    Case("library of a run's folder above", "FILE_TRUNCATED", 2, "step-000030000.ckpt", "truncated", "Copy or download", ["search", "room.safetensors", "run", *REGISTER[3:]]),
    Case("converting to an unknown format", "INVALID_OPTIONS", 2, "out.xyz", "expected a name that ends in", "suffix", ["convert", "chair.safetensors", "out.xyz"]),
    Case("converting into no folder", "INVALID_OPTIONS", 2, "there", "no such folder", "mkdir", ["convert", "chair.safetensors", "there/out.ply"]),
    Case("picture of no PNG", "INVALID_OPTIONS", 2, "a.jpg", "ends in .png", "--picture field.png", ["inspect", "chair.safetensors", "--picture", "a.jpg"]),
    Case("server without scheme", "INVALID_ADDRESS", 2, "localhost:8080", "http://", "Did you mean http://localhost:8080", [*REGISTER, "--server", "localhost:8080"]),
    Case("server of another scheme", "INVALID_ADDRESS", 2, "ftp://host", "http:// or https://", "regnf serve", [*REGISTER, "--server", "ftp://host"]),
    Case("worker without Redis", "REDIS_URL_MISSING", 3, "REGNF_REDIS_URL", "no address of a Redis", "redis://|regnf serve", ["worker"]),
    Case("Redis that is no address", "INVALID_SETTINGS", 2, "--redis-url", "expected redis://", "Write for example", ["worker", "--redis-url", "localhost"]),
    Case("Redis that does not run", "REDIS_UNAVAILABLE", 3, "127.0.0.1:9", "does not answer", "Start Redis", ["worker", "--redis-url", "redis://127.0.0.1:9/0"]),
    Case("port out of range", "USAGE", 2, "--port", "65535", "regnf serve " + HELP, ["serve", "--port", "70000"]),
    Case("state folder a file", "STATE_DIR_UNUSABLE", 3, "box.json", "cannot keep state", "--state-dir", ["serve", "--state-dir", "box.json"]),
    Case("open to others without tokens", "UNAUTHENTICATED_PUBLIC_BIND", 3, "0.0.0.0", "no token is configured", "Set REGNF_API_TOKENS", ["serve", "--state-dir", "state", "--host", "0.0.0.0"]),
    Case("open to others without a proxy", "PROXY_MISSING", 3, "0.0.0.0", "slow or hostile connections", "REGNF_BEHIND_PROXY=true", ["serve", "--state-dir", "tokens", "--host", "0.0.0.0"]),
    Case("address of another machine", "ADDRESS_UNAVAILABLE", 3, "192.0.2.1", "cannot listen", "--host", ["serve", "--state-dir", "state", "--host", "192.0.2.1"]),
]  # fmt: skip


@parametrized(CASES)
def test_a_wrong_command(case: Case, run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if case.reason in ("ADDRESS_UNAVAILABLE", "PROXY_MISSING"):
        monkeypatch.setenv("REGNF_API_TOKENS", '["robot:0123456789abcdef0123456789abcdef"]')
        monkeypatch.setenv("REGNF_BEHIND_PROXY", str(case.reason == "ADDRESS_UNAVAILABLE"))
    case.prepare(folder)
    outcome = run(*case.how, code=case.code)
    assert case.reason in outcome.stderr
    assert outcome.stdout == ""
    case.check(outcome.stderr)


def test_a_port_in_use(run: Run, folder: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        outcome = run("serve", "--state-dir", "state", "--port", port)
    assert outcome.code == 3
    Case("", "", 3, f"127.0.0.1, port {port}", "cannot listen", "--port 0").check(outcome.stderr)


def test_two_services_on_one_state_folder(run: Run, folder: Path) -> None:
    from regnf_cli.supervisor import StateLock

    with StateLock(folder / "state") as held:
        held.note(address="http://127.0.0.1:1")
        outcome = run("serve", "--state-dir", "state", "--port", 0)
    assert outcome.code == 3
    other = rf"another `regnf serve` \(process {os.getpid()}, http://127.0.0.1:1\) uses"
    Case("", "", 3, "STATE_DIR_IN_USE .*/state", other, "--state-dir").check(outcome.stderr)


@pytest.mark.parametrize(
    ("name", "value", "pattern"),
    [
        ("REGNF_WORKERS", "many", "REGNF_WORKERS: .*integer.*hint: Correct the environment variable"),
        ("REGNF_REDIS_URL", "localhost:6379", "REGNF_REDIS_URL: .*expected redis://.*hint: Write for example"),
        ("REGNF_API_TOKENS", '["a:"]', "TOKENS_UNUSABLE .*has no token.*hint: Write entries as NAME:TOKEN"),
    ],
)
def test_wrong_settings(
    name: str, value: str, pattern: str, run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, value)
    outcome = run("serve", "--state-dir", "state", "--port", 0)
    assert outcome.code in (2, 3), outcome.stderr
    Case("", "", 2, pattern, "expected|should|token", "hint: ").check(outcome.stderr)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_an_output_that_cannot_be_written(run: Run, folder: Path) -> None:
    (folder / "closed").mkdir(mode=0o500)
    outcome = run(*REGISTER, "--output", "closed/out")
    assert outcome.code == 2, outcome.stderr
    Case("", "", 2, "closed/out", "Permission denied", "Check the permissions").check(outcome.stderr)


def test_a_server_that_does_not_run(run: Run, folder: Path) -> None:
    with socket.socket() as bound:  # bound, but nobody listens
        bound.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{bound.getsockname()[1]}"
        outcome = run(*REGISTER, "--server", address)
    assert outcome.code == 3
    Case("", "", 3, f"SERVICE_UNAVAILABLE {address}", "does not answer", "regnf serve").check(outcome.stderr)


def refusing(status: int, document: dict[str, object]) -> Answers:
    return lambda method, path: (status, json.dumps(document))


SERVERS = [
    Case("another web server", "SERVICE_ERROR", 2, "HTTP status 404 from http://127", "no regnf service", "Check address and port", lambda method, path: (404, "<html>")),
    Case("another JSON service", "SERVICE_ERROR", 2, "HTTP status 200|HTTP status 404", "no regnf service", "Check address", lambda method, path: (404, '{"message": "no"}')),
    Case("no token", "UNAUTHENTICATED", 2, "UNAUTHENTICATED", "token", "REGNF_API_TOKEN", refusing(401, {"reason": "UNAUTHENTICATED", "detail": "Send a token."})),
    Case("no worker", "NO_WORKER", 3, "no live worker", "for 0 s", "regnf worker", without_worker("jobs")),
    Case("no worker for the fields", "NO_WORKER", 3, "no live worker", "for 0 s", "regnf worker", without_worker("fields")),
    Case("queue full", "QUEUE_FULL", 3, "QUEUE_FULL", "as many", "again later", refusing(503, {"reason": "QUEUE_FULL", "detail": "as many jobs as it takes"})),
    Case("a field that was rejected", "FIELD_SHAPES", 2, "chair.safetensors: wrong shapes", "wrong shapes", "another", lambda method, path: (200, field(path, state="rejected", error={"reason": "FIELD_SHAPES", "detail": "wrong shapes", "hint": "Try another."}))),
]  # fmt: skip


@parametrized(SERVERS)
def test_a_wrong_server(case: Case, run: Run, folder: Path, serve: Serve) -> None:
    outcome = run(*REGISTER, "--server", serve(case.how), "--worker-timeout", 0, code=case.code)
    assert case.reason in outcome.stderr
    case.check(outcome.stderr)


@pytest.fixture
def interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("regnf_client.Client.wait", interrupt)


def test_job_and_page_are_told_at_the_start(run: Run, folder: Path, serve: Serve) -> None:
    address = serve(service())
    outcome = run(*REGISTER, "--server", f"{address}/", "--json", code=0)
    assert f"page         {address}/jobs/j/view" in outcome.stderr
    assert json.loads(outcome.stdout)["verdict"] == "registered"  # nothing else is printed there


@pytest.mark.usefixtures("interrupted")
@pytest.mark.parametrize("cancel", [False, True])
def test_an_interrupted_job_goes_on_or_is_cancelled_on_request(
    cancel: bool, run: Run, folder: Path, serve: Serve
) -> None:
    calls: list[tuple[str, str]] = []

    def answers(method: str, path: str) -> tuple[int, str]:
        calls.append((method, path))
        return service()(method, path)

    address = serve(answers)
    outcome = run(*REGISTER, "--server", address, *(["--cancel-on-interrupt"] if cancel else []))
    assert (outcome.code, ("POST", "/jobs/j/cancel") in calls) == (130, cancel)
    told = (f"{address}/jobs/j/view", f"curl -X POST {address}/jobs/j/cancel")
    said = ("canceled the job j", "", "") if cancel else ("the job j continues", *told)
    Case("", "", 130, *said).check(outcome.stderr)


def test_an_interrupted_local_registration_ends_with_130(
    run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("regnf_cli.registration.register_here", interrupt)
    outcome = run(*REGISTER, code=130)
    assert "Traceback" not in outcome.stderr
