"""Every code block of the pages for readers runs, in the order of its page, as a reader would run it."""

from __future__ import annotations

import os
import re
import shlex
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from tests.cli.conftest import Run, run
from tests.contract.live import eventually
from tests.docs.pages import DOCS, ROOT, Block, blocks, reader_pages

__all__ = ["run"]
ADDRESS = "127.0.0.1:8080"
SERVE = "regnf serve\n"
RUN = [page for page in reader_pages() if any(block.language in ("bash", "python") for block in blocks(page))]
SHOWN = [
    (page, code.replace("\\\n", " ").strip().splitlines()[-1], told)
    for page in (ROOT / "README.md", *reader_pages())
    for code, told in re.findall(
        r"```bash\n((?:(?!```).)*?)```(?:(?!```).)*?```text\n(verdict .*?)```",
        page.read_text(encoding="utf-8"),
        flags=re.S,
    )
]
"""The pages that show what `regnf register` prints: the command, the first lines of its output."""
NUMBER = re.compile(r"-?\d+\.\d+")
ELSEWHERE = re.compile(
    r"make |source |pip |python3 -m venv|scripts/|cp DATA|cp -r ros2|rosdep|colcon|ros2 |ns-train|regnf \w+"
)


def environment(folder: Path) -> dict[str, str]:
    tools = folder / "bin"
    tools.mkdir()
    for name, module in (("regnf", ["-m", "regnf_cli.main"]), ("python", [])):
        (tools / name).write_text(f'#!/bin/sh\nexec {" ".join([sys.executable, *module])} "$@"\n')
        (tools / name).chmod(0o755)
    plain = {name: value for name, value in os.environ.items() if not name.startswith("REGNF_")}
    paths = os.pathsep.join(str(ROOT / part) for part in ("", "service", "worker"))
    own = {"PATH": f"{tools}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": paths}
    return plain | own | {"REGNF_STATE_DIR": str(folder / "state"), "XDG_CACHE_HOME": str(folder / "cache")}


def alike(told: str, printed: str) -> bool:
    """The words are the same, the numbers rounded: they differ between machines in the last digits."""
    words = [re.sub(r"\s+", " ", NUMBER.sub("#", text)).strip() for text in (told, printed)]
    numbers = [[float(one) for one in NUMBER.findall(text)] for text in (told, printed)]
    return words[0] == words[1] and numbers[1] == pytest.approx(numbers[0], rel=0.05, abs=2e-4)


def promised(text: str) -> list[str]:
    """What a page says that its blocks print; the service's own address is another one in the tests."""
    found = re.findall(r"it prints `((?!regnf serves)[^`]+)`|print\(.*\)  # (<.+>)", text, flags=re.I)
    return [sentence or comment for sentence, comment in found]


def ended(command: list[str], text: str, folder: Path, variables: dict[str, str]) -> tuple[int, str]:
    """The exit code of a block, and what to show of it where that is not 0."""
    done = subprocess.run(
        command, input=text, cwd=folder, env=variables, capture_output=True, text=True, timeout=280, check=False
    )
    return done.returncode, f"{text}\n{done.stdout}\n{done.stderr}"


@contextmanager
def serving(wanted: bool, folder: Path, variables: dict[str, str]) -> Iterator[str]:
    """The service that a page tells its reader to start, at a free port; its address."""
    if not wanted:
        yield ADDRESS
        return
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with (folder / "serve.log").open("wb") as log:
        command = [sys.executable, "-m", "regnf_cli.main", "serve", "--port", str(port)]
        process = subprocess.Popen(command, env=variables, cwd=folder, stdout=log, stderr=log)
    try:
        eventually(lambda: is_ready(port), f"the service; {(folder / 'serve.log').read_text()}", deadline_s=120)
        yield f"127.0.0.1:{port}"
    finally:
        process.terminate()
        process.wait(60)


def is_ready(port: int) -> bool:
    try:
        return httpx.get(f"http://127.0.0.1:{port}/readyz", timeout=5).status_code == 200
    except httpx.TransportError:
        return False


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize("page", RUN, ids=lambda page: str(page.relative_to(DOCS)))
def test_the_blocks_of_a_page_run(page: Path, tmp_path: Path) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    variables = environment(tmp_path)
    found = blocks(page)
    with serving(Block("bash", SERVE) in found, tmp_path, variables) as address:
        program = printed = ""
        for block in found:
            code = block.code.replace(ADDRESS, address)
            if block.language == "bash" and block.code != SERVE:
                status, shown = ended(["bash", "-euo", "pipefail"], code, tmp_path, variables)
                assert status == 0, shown
                printed += shown
            elif block.language == "python":
                program += code
        if program:
            status, shown = ended([sys.executable, "-W", "error", "-"], program, tmp_path, variables)
            assert status == 0, shown
            printed += shown
        for told in promised(page.read_text(encoding="utf-8")):
            assert any(alike(told, line) for line in printed.splitlines()), told


def test_blocks_are_of_known_languages_and_what_is_not_run_cannot_be() -> None:
    for page in reader_pages():
        for block in blocks(page):
            assert block.language in ("bash", "python", "json", "console", "text"), page
            if block.language == "console":
                assert ELSEWHERE.match(block.code), f"{page}: {block.code}"
    assert {"tutorial.md", "batch.md", "verdicts.md", "units.md", "page.md"} <= {page.name for page in RUN}


@pytest.mark.parametrize(("page", "line", "told"), SHOWN, ids=[page.name for page, _, _ in SHOWN])
def test_a_page_shows_what_the_command_prints(
    page: Path, line: str, told: str, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    done = run(*shlex.split(line)[1:])
    assert alike(told, "\n".join(done.stdout.splitlines()[: len(told.splitlines())]))


def test_outputs_are_found_and_compared() -> None:
    assert "tutorial.md" in {page.name for page, _, _ in SHOWN}
    told = "probability  98.5 % that"
    assert alike(told, "probability 98.6 % that")
    assert not alike(told, "probability  88.5 % that")
    assert not alike(told, "chance  98.5 % that")
    assert promised("It prints `a 1.0`.\n    print(b)  # <b: 2>\n    print(c)  # of c\n") == ["a 1.0", "<b: 2>"]
