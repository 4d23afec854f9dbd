"""From a fresh `regnf serve` to a registered chair of one's own files, by mouse alone. Nothing is pretended.

With REGNF_RECORD=FOLDER the frames are kept there, and the seconds from the first action to each.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.ui import room
from tests.ui.conftest import Visit
from tests.ui.home import click_at

pytestmark = [pytest.mark.browser, pytest.mark.long, pytest.mark.timeout(900)]
CHAIR = (0.614, 0.598)
"""Where the chair is seen at first, as shares of the view."""
PATIENCE_MS = 400_000
VIEWPORT = (1280, 800)


@pytest.fixture
def serving(tmp_path: Path) -> Iterator[str]:
    command = [sys.executable, "-m", "regnf_cli.main", "serve", "--port", "0", "--state-dir", str(tmp_path / "state")]
    plain = {name: value for name, value in os.environ.items() if not name.startswith("REGNF_")}
    with (
        (tmp_path / "log").open("w") as log,
        subprocess.Popen(command, env=plain, stdout=subprocess.PIPE, stderr=log, text=True) as process,
    ):
        try:
            assert process.stdout is not None
            found = re.search(r"http://\S+", process.stdout.readline())
            assert found is not None, (tmp_path / "log").read_text()
            yield found[0]
        finally:
            process.terminate()
            process.wait()


def frame(page: Page, name: str, since: float) -> None:
    """Keep what is shown, and when; nothing is written without REGNF_RECORD."""
    if folder := os.environ.get("REGNF_RECORD"):
        page.screenshot(path=Path(folder) / f"{name}.png")
        with (Path(folder) / "seconds.txt").open("a") as file:
            file.write(f"{name} {time.monotonic() - since:.1f}\n")


def test_four_actions_to_a_registered_chair(visit: Visit, serving: str, tmp_path: Path) -> None:
    page = visit.page
    scene, chair = room.write_room_and_chair(tmp_path)
    page.goto(serving)
    page.wait_for_selector("html[data-page=ready]")
    began = time.monotonic()
    frame(page, "1-start", began)
    with page.expect_file_chooser() as chooser:
        page.get_by_text("Choose a scene").click()  # 1
    chooser.value.set_files(scene)
    with page.expect_file_chooser() as chooser:
        page.get_by_text("Add files").click()  # 2
    chooser.value.set_files(chair)
    page.wait_for_selector("html[data-scene]", timeout=PATIENCE_MS)
    frame(page, "2-scene", began)
    click_at(page, CHAIR)  # 3
    page.wait_for_selector("#objects input:checked", timeout=PATIENCE_MS)
    frame(page, "3-box", began)
    page.click("#register")  # 4
    page.wait_for_selector("#runs progress")
    frame(page, "4-running", began)
    page.wait_for_selector(".run[data-verdict], .run .bad", timeout=PATIENCE_MS)
    expect(page.locator(".run strong")).to_have_text("Box 1, registered: chair.glb")
    page.wait_for_function("() => document.querySelectorAll('#handles button:not([hidden])').length === 0")
    frame(page, "5-registered", began)
    expect(page.locator(".run")).to_contain_text(f"scale {room.CHAIR_SCALE:.2f}"[:-1])
    assert [url for url in visit.requests if not url.startswith((serving, "blob:"))] == []
    page.goto("about:blank")
