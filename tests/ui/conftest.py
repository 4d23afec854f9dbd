"""The browser and the pretended service, shared by the tests of the page."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
import trimesh
from playwright.sync_api import Browser, ConsoleMessage, Page, sync_playwright

from regnf_state.settings import Settings
from tests.ui import room
from tests.ui.home import home, register, upload
from tests.ui.stories import FixtureServer

# SwiftShader draws WebGL without a GPU, and nothing else, being slow. The others keep the browser from calling home.
ARGUMENTS = [
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip
Files = tuple[Path, Path, Path]

DRIVER = "GL Driver Message"
"""Begins what the drawing library says of its own speed; the page has no part in it."""


@dataclass
class Visit:
    page: Page
    server: FixtureServer
    requests: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    def open(self, story: str) -> Page:
        """Opens the page of a job that has ended and waits until it is filled."""
        self.page.goto(self.server.view(story))
        self.page.wait_for_selector("html[data-page=ready]")
        return self.page


def chromium() -> str:
    """The installed browser; without one the test is skipped, or fails where REGNF_REQUIRE_BROWSER=1 asks for it."""
    found = shutil.which("chromium") or shutil.which("chromium-browser")
    if found is None and os.environ.get("REGNF_REQUIRE_BROWSER") == "1":
        pytest.fail("no chromium on this machine, and REGNF_REQUIRE_BROWSER=1 asks for it")
    return found or pytest.skip("no chromium on this machine: the page is not tested")


@pytest.fixture(scope="package")  # its loop of events must not outlive these tests
def browser() -> Iterator[Browser]:
    program = chromium()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def running_server() -> Iterator[FixtureServer]:
    with FixtureServer() as server:
        yield server


@pytest.fixture
def server(running_server: FixtureServer) -> FixtureServer:
    running_server.stage.set(step=0, cancelled=False)
    return running_server


@pytest.fixture
def context_options(request: pytest.FixtureRequest) -> dict[str, Any]:
    """What a test overrides to look through another kind of screen; a module's VIEWPORT says how large it is."""
    width, height = getattr(request.module, "VIEWPORT", (1000, 600))
    return {"viewport": {"width": width, "height": height}, "reduced_motion": "reduce"}


Open = Callable[[dict[str, Any]], Page]


@pytest.fixture(scope="package")
def open_window(browser: Browser) -> Open:
    """``open_window(options)``: a page in a window of its own, which takes the browser longer than a test."""

    def open_it(options: dict[str, Any]) -> Page:
        context = browser.new_context(**options)
        context.set_default_timeout(60_000)
        return context.new_page()

    return open_it


@pytest.fixture(scope="package")
def kept_window() -> dict[str, Page]:
    """The window that tests share, by its options; at most one."""
    return {}


def forget(page: Page) -> None:
    page.unroute_all()
    page.context.set_offline(False)
    page.context.clear_permissions()
    page.emulate_media(color_scheme="light", reduced_motion="reduce")
    if page.url.startswith("http"):
        page.evaluate("() => { sessionStorage.clear(); localStorage.clear(); }")
    page.goto("about:blank")


@pytest.fixture
def shared_page(open_window: Open, kept_window: dict[str, Page], context_options: dict[str, Any]) -> Iterator[Page]:
    key = repr(context_options)
    if key not in kept_window:
        for other in kept_window.values():
            other.context.close()
        kept_window.clear()
        kept_window[key] = open_window(context_options)
    yield kept_window[key]
    forget(kept_window[key])


@pytest.fixture
def own_page(open_window: Open, context_options: dict[str, Any]) -> Iterator[Page]:
    """For a test that leaves traces in its window: a script that runs in every page, say."""
    page = open_window(context_options)
    yield page
    page.context.close()


@pytest.fixture
def visit(request: pytest.FixtureRequest, server: FixtureServer) -> Iterator[Visit]:
    name = "own_page" if "own_page" in request.fixturenames else "shared_page"
    page: Page = request.getfixturevalue(name)
    visit = Visit(page, server)

    def said(message: ConsoleMessage) -> None:
        if message.type != "info" and DRIVER not in message.text:
            visit.complaints.append(message.text)

    listeners: dict[Any, Callable[[Any], None]] = {
        "request": lambda message: visit.requests.append(message.url),
        "pageerror": lambda error: visit.complaints.append(str(error)),
        "console": said,
    }
    for event, listener in listeners.items():
        page.on(event, listener)
    yield visit
    for event, listener in listeners.items():
        page.remove_listener(event, listener)


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    folder = tmp_path_factory.mktemp("own")
    stool = folder / "stool.glb"
    trimesh.creation.box((0.4, 0.3, 0.5)).export(stool)
    return (*room.write_room_and_chair(folder), stool)


@pytest.fixture(scope="package")
def running_home() -> Iterator[str]:
    with home(Settings()) as address:
        yield address


@pytest.fixture
def service(running_home: str, visit: Visit) -> Iterator[str]:
    yield running_home
    if visit.page.url.startswith(running_home):
        visit.page.evaluate("() => { sessionStorage.clear(); localStorage.clear(); }")
    visit.page.goto("about:blank")  # lets go of the connections
    kinds = {"jobs": "id", "library": "name", "fields": "sha256", "recordings": "sha256"}
    for kind, key in kinds.items():
        listed = httpx.get(f"{running_home}/{kind}", headers={"Accept": "application/json"}).json()
        for one in listed.get(kind) or listed.get("entries") or []:
            httpx.delete(f"{running_home}/{kind}/{one[key]}").raise_for_status()


@pytest.fixture
def filled(service: str, files: Files) -> str:
    register(service, upload(service, files[:2]))
    return service
