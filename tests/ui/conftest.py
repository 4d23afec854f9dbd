"""The browser and the pretended service, shared by the tests of the page."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from tests.ui.fixture_server import FixtureServer

# SwiftShader draws WebGL without a GPU; the other switches keep the browser from calling home.
ARGUMENTS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@dataclass
class Visit:
    """One open page, with everything it asked for and complained about."""

    page: Page
    server: FixtureServer
    requests: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    def open(self, story: str) -> Page:
        """Opens the page of a job that has ended and waits until it is filled."""
        self.page.goto(self.server.view(story))
        self.page.wait_for_selector("html[data-page=ready]")
        return self.page


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        if os.environ.get("REGNF_REQUIRE_BROWSER") == "1":
            pytest.fail("no chromium on this machine, and REGNF_REQUIRE_BROWSER=1 asks for it")
        pytest.skip("no chromium on this machine: the page is not tested")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def running_server() -> Iterator[FixtureServer]:
    with FixtureServer() as server:
        yield server


@pytest.fixture
def server(running_server: FixtureServer) -> FixtureServer:
    running_server.stage.reset()
    return running_server


@pytest.fixture
def context_options() -> dict[str, Any]:
    """What a test overrides to look through another kind of screen."""
    return {"viewport": {"width": 1100, "height": 700}, "reduced_motion": "reduce"}


@pytest.fixture
def visit(browser: Browser, server: FixtureServer, context_options: dict[str, Any]) -> Iterator[Visit]:
    context = browser.new_context(**context_options)
    context.set_default_timeout(60_000)
    page = context.new_page()
    visit = Visit(page, server)
    page.on("request", lambda request: visit.requests.append(request.url))
    page.on("pageerror", lambda error: visit.complaints.append(str(error)))
    page.on("console", lambda message: visit.complaints.append(message.text) if message.type != "info" else None)
    yield visit
    context.close()
