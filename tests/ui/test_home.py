"""The home page over the real application: files, a click, a box, a registration, lists. The worker is pretended."""

from __future__ import annotations

import re
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import trimesh
from playwright.sync_api import Page, Route, expect

from regnf_service.server import create_app
from regnf_state.ownership import ANONYMOUS
from regnf_state.settings import Settings
from tests.stores import private_stores
from tests.ui import room
from tests.ui.conftest import Visit
from tests.ui.pretend_worker import PretendWorker
from tests.ui.test_real_app import _Server

pytestmark = pytest.mark.browser
NETWORK = "Failed to load resource"
"""Begins what the browser says of an answer that is no success; the page shows what it makes of it."""
CHAIR = (0.417, 0.484)
"""Where the chair is seen at first, as shares of the view."""


def true_pose() -> np.ndarray:
    """T_scene_object of the chair's file in the room."""
    stands = trimesh.transformations.rotation_matrix(room.CHAIR_TURN, (0, 0, 1))
    stands[:3, 3] = (*room.CHAIR_AT, 0.002)
    own = np.diag([1 / room.CHAIR_SCALE] * 3 + [1.0])
    own[:3, 3] = -np.array([3.0, 1.0, 0.0]) / room.CHAIR_SCALE
    return stands @ own


@contextmanager
def home(settings: Settings, caller: str = ANONYMOUS) -> Iterator[str]:
    """The address of the application with a worker that ends everything at once."""
    with private_stores() as stores:
        server = _Server(create_app(settings, stores))
        with socket.create_server(("127.0.0.1", 0)) as listener:
            thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
            thread.start()
            try:
                with PretendWorker(stores.records, stores.blobs, caller, true_pose().tolist()):
                    yield f"http://127.0.0.1:{listener.getsockname()[1]}"
            finally:
                server.should_exit = True
                thread.join()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return room.write_room_and_chair(tmp_path_factory.mktemp("own"))


def give_files(page: Page, files: tuple[Path, Path]) -> None:
    page.set_input_files("#scene-file", files[0])
    page.set_input_files("#object-file", files[1])
    page.wait_for_selector("html[data-scene]")
    expect(page.locator("#objects input:checked")).to_have_count(1)


def click_at(page: Page, place: tuple[float, float]) -> None:
    box = page.locator("#canvas").bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + place[0] * box["width"], box["y"] + place[1] * box["height"])


def numbers_of(page: Page) -> dict[str, float]:
    inputs = page.locator("#box-numbers input")
    names = [str(inputs.nth(i).get_attribute("aria-label")) for i in range(inputs.count())]
    return {name: float(inputs.nth(i).input_value()) for i, name in enumerate(names)}


@pytest.fixture
def context_options() -> dict[str, object]:
    return {"viewport": {"width": 1280, "height": 800}, "reduced_motion": "reduce"}


def test_from_files_to_a_registered_chair(visit: Visit, files: tuple[Path, Path]) -> None:
    page = visit.page
    with home(Settings()) as address:
        page.goto(address)
        page.wait_for_selector("html[data-page=ready]")
        give_files(page, files)
        click_at(page, CHAIR)
        expect(page.locator("#boxes li")).to_have_count(1)
        found = numbers_of(page)
        # the chair is 0.57 by 0.565 by 1 m, turned by 0.6 radians
        assert found["Center x"] == pytest.approx(room.CHAIR_AT[0], abs=0.06)
        assert found["Center y"] == pytest.approx(room.CHAIR_AT[1], abs=0.06)
        assert found["Size z"] == pytest.approx(1.0, abs=0.12)
        assert max(found["Size x"], found["Size y"]) < 0.72
        turn = found["Turn about the up axis, degrees"]
        assert (turn - np.degrees(room.CHAIR_TURN) + 45) % 90 == pytest.approx(45, abs=5)
        page.click("#register")
        expect(page.locator(".run strong")).to_have_text("Box 1, registered: chair.glb")
        page.click(".run a")
        expect(page.locator("#verdict-word")).to_have_text("Registered")
        page.goto(f"{address}/jobs")
        expect(page.locator(".tile h2")).to_have_text("chair.glb in room.ply")
        page.locator("#search").fill("table")
        expect(page.locator(".tile")).to_have_count(0)
        page.locator("#search").fill("")
        page.get_by_role("button", name="Delete").click()
        page.locator("dialog[open]").get_by_role("button", name="Delete").click()
        expect(page.locator("#note")).to_have_text(re.compile("No jobs yet"))
        page.goto(f"{address}/fields")
        expect(page.locator(".tile h2")).to_have_count(2, timeout=20_000)
        assert sorted(page.locator(".tile h2").all_inner_texts()) == ["chair.glb", "room.ply"]  # they were sent at once
        page.locator(".tile", has_text="room.ply").get_by_role("link", name="Use as scene").click()
        page.wait_for_selector("html[data-scene]")
        assert [one for one in visit.complaints if not one.startswith(NETWORK)] == []
        assert [url for url in visit.requests if not url.startswith((address + "/", "blob:"))] == []
        page.goto("about:blank")


def test_boxes_are_edited_by_mouse_keys_and_numbers(visit: Visit, files: tuple[Path, Path]) -> None:
    page = visit.page
    with home(Settings()) as address:
        page.goto(address)
        give_files(page, files)
        click_at(page, CHAIR)
        before = numbers_of(page)
        page.locator(".handle.turn").focus()
        page.keyboard.press("ArrowRight")
        assert numbers_of(page)["Turn about the up axis, degrees"] == pytest.approx(
            before["Turn about the up axis, degrees"] + 5, abs=0.2
        )
        top = page.locator(".handle[aria-label='Top']").bounding_box()
        assert top is not None
        page.mouse.move(top["x"] + top["width"] / 2, top["y"] + top["height"] / 2)
        page.mouse.down()
        page.mouse.move(top["x"] + top["width"] / 2, top["y"] - 30, steps=3)
        page.mouse.up()
        after = numbers_of(page)
        assert after["Size z"] > before["Size z"] + 0.1
        low = before["Center z"] - before["Size z"] / 2
        assert after["Center z"] - after["Size z"] / 2 == pytest.approx(low, abs=1e-3)  # the bottom stays
        page.locator("#numbers summary").click()
        page.locator("input[aria-label='Size x']").fill("2")
        page.keyboard.press("Enter")
        expect(page.locator("#boxes button").first).to_have_text(re.compile("Box 1: 2 × "))
        page.click("#add-box")
        click_at(page, (0.63, 0.67))  # the lamp on the table
        expect(page.locator("#boxes li")).to_have_count(2)
        page.get_by_role("button", name="Remove box 1").click()
        expect(page.locator("#boxes li")).to_have_count(1)
        page.goto("about:blank")


def test_guarded_service_asks_for_the_token_once(visit: Visit, files: tuple[Path, Path]) -> None:
    page = visit.page
    with home(Settings(api_tokens=frozenset({"robot:open-sesame"})), "robot") as address:
        page.goto(address)
        page.locator("#token").fill("open-sesame")
        page.keyboard.press("Enter")
        page.wait_for_selector("html[data-page=ready]")
        give_files(page, files)
        page.goto(f"{address}/fields")
        expect(page.locator(".tile")).to_have_count(2)
        page.goto("about:blank")


def test_refused_file_says_why(visit: Visit, tmp_path: Path) -> None:
    page = visit.page
    (tmp_path / "empty.ply").write_bytes(b"hello, this is no field")
    with home(Settings()) as address:
        page.goto(address)
        page.wait_for_selector("html[data-page=ready]")
        page.set_input_files("#scene-file", tmp_path / "empty.ply")
        expect(page.locator("#scene-state .bad")).to_contain_text("empty.ply: ")
        page.goto("about:blank")


def test_run_again_and_compare(visit: Visit, files: tuple[Path, Path]) -> None:
    page = visit.page
    with home(Settings()) as address:
        page.goto(address)
        give_files(page, files)
        click_at(page, CHAIR)
        page.click("#register")
        page.wait_for_selector(".run[data-verdict]")
        page.goto(f"{address}/jobs")
        page.get_by_role("button", name="Run again").click()
        page.get_by_label("Seed").fill("7")
        page.locator("dialog[open] summary").click()
        page.get_by_label("Min inlier share").fill("0.5")
        page.click("#again-start")
        page.wait_for_url("**/view")
        page.goto(f"{address}/jobs")
        expect(page.locator(".tile")).to_have_count(2)
        expect(page.locator(".tile .word")).to_have_text(["Registered", "Registered"])
        expect(page.locator(".tile").first).to_contain_text("seed 7")
        expect(page.locator("#compare")).to_be_disabled()
        for mark in page.get_by_role("checkbox", name=re.compile("^Compare")).all():
            mark.check()
        page.click("#compare")
        expect(page.locator("#comparison")).to_contain_text("turned by 0.00°")
        assert [one for one in visit.complaints if not one.startswith(NETWORK)] == []
        page.goto("about:blank")


def test_run_again_keeps_what_the_form_does_not_show(visit: Visit, files: tuple[Path, Path]) -> None:
    page = visit.page
    with home(Settings()) as address:
        page.goto(address)
        give_files(page, files)
        fields = page.request.get(f"{address}/fields").json()["fields"]
        named = {one["label"]: one["sha256"] for one in fields}
        options = {"preset": "paper", "optimization": {"iterations": 7}}
        turned = [[0, -1, 0, 0.3], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        box = {"center": [0.9, 0.6, 0.5], "size": [0.8, 0.8, 1.1]}
        asked = {"scene": named["room.ply"], "object": named["chair.glb"], "detection": box, "options": options}
        posted = page.request.post(f"{address}/register", data=asked | {"ground_truth": {"T_object_scene": turned}})
        assert posted.status == 202, posted.text()
        page.goto(f"{address}/jobs")
        page.get_by_role("button", name="Run again").click()
        page.get_by_label("Seed").fill("9")
        page.click("#again-start")
        page.wait_for_url("**/view")
        again = page.request.get(page.url.removesuffix("/view") + "/request").json()
        assert (again["options"]["optimization"]["iterations"], again["seed"]) == (7, 9)
        assert again["ground_truth"] == {"T_object_scene": turned}
        page.goto("about:blank")


def refuse_lists(page: Page, answers: int) -> list[str]:
    """Have the store of records busy at the first requests for the list of fields; the addresses asked for."""
    asked: list[str] = []

    def busy(route: Route) -> None:
        asked.append(route.request.url)
        if len(asked) > answers:
            return route.continue_()
        problem = '{"reason": "STORE_UNAVAILABLE", "detail": "The record store does not answer. Retry later."}'
        return route.fulfill(status=503, headers={"Retry-After": "0"}, body=problem)

    page.route("**/fields?*", busy)
    return asked


def test_the_page_asks_again_while_the_store_is_busy(visit: Visit) -> None:
    page = visit.page
    asked = refuse_lists(page, 3)
    with home(Settings()) as address:
        page.goto(address)
        page.wait_for_selector("html[data-page=ready]")
        assert len(asked) > 3
        expect(page.locator("#tip")).to_be_hidden()
        page.goto("about:blank")


def test_the_page_says_that_the_store_stays_busy(visit: Visit) -> None:
    page = visit.page
    refuse_lists(page, 1000)
    with home(Settings()) as address:
        page.goto(address)
        page.wait_for_selector("html[data-page=ready]")
        expect(page.locator("#tip")).to_contain_text("The record store does not answer.")
        page.goto("about:blank")
