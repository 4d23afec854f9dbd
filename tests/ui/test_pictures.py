"""Recordings and frames on the pages: things marked in pictures, and results in them. The worker is pretended."""

from __future__ import annotations

import io
import re
import tarfile
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Page, expect

from tests.contract.live import eventually
from tests.frame_forms import COLOR, DEPTH, MASK, SIZE, archive, stored
from tests.ui.conftest import Files, Visit
from tests.ui.home import NETWORK, box_of, open_page
from tests.ui.test_access import NONE, in_both_themes

pytestmark = pytest.mark.browser
VIEWPORT = (1280, 800)


def request_of_the_run(page: Page) -> dict[str, Any]:
    """What the only job that was started was asked for."""
    page.wait_for_selector(".run[data-verdict]")
    address = str(page.locator(".run a").get_attribute("href")).removesuffix("/view")
    request: dict[str, Any] = page.request.get(f"{page.url.split('/?')[0].rstrip('/')}{address}/request").json()
    return request


def at(page: Page, u: float, v: float) -> tuple[float, float]:
    """Where a pixel of the picture is on the screen."""
    box = box_of(page, "#sheet")
    return box["x"] + box["width"] * u / SIZE[1], box["y"] + box["height"] * v / SIZE[0]


def test_a_frame_is_given_its_thing_clicked_and_the_overlay_shown(
    visit: Visit, service: str, files: Files, tmp_path: Path
) -> None:
    page = visit.page
    for name, data in {"depth.png": DEPTH, "color.png": COLOR, "mask.png": MASK}.items():
        (tmp_path / name).write_bytes(data)
    open_page(page, service)
    page.set_input_files("#scene-file", tmp_path / "color.png")
    expect(page.locator("#welcome-state")).to_contain_text("The depth image of the frame is missing")
    page.set_input_files("#scene-file", [tmp_path / name for name in ("depth.png", "color.png", "mask.png")])
    expect(page.locator("#camera-fx")).to_be_focused()
    expect(page.locator("#camera-cx")).to_have_attribute("placeholder", "7.5")
    page.locator("#camera-fx").fill("14")
    page.keyboard.press("Enter")
    page.wait_for_selector("html[data-scene]")
    expect(page.locator("#boxes")).to_contain_text("Mark 1: a mask")  # it came with the frame
    expect(page.locator("#strip")).to_be_hidden()
    page.set_input_files("#object-file", files[2])
    page.wait_for_selector("#objects input:checked")
    page.select_option("#object-unit", "mm")
    page.get_by_role("button", name="Remove mark 1").click()
    page.set_input_files("#scene-file", tmp_path / "mask.png")  # of the picture that is shown
    expect(page.locator("#boxes")).to_contain_text("Mark 2: a mask")
    page.mouse.click(*at(page, 8.0, 6.0))
    expect(page.locator("#boxes button").first).to_have_text("Mark 2: pixel 8, 6")
    page.click("#register")
    request = request_of_the_run(page)
    (seen,) = [request["detection"]] if isinstance(request["detection"], dict) else request["detection"]
    assert seen["point_2d"] == pytest.approx([8.0, 6.0], abs=0.1)
    assert request["options"]["robust"]["object_unit"] == "mm"
    expect(page.locator(".run strong")).to_have_text("Mark 2, registered: stool.glb")
    expect(page.locator(".run")).to_contain_text(re.compile(r"in the camera’s frame: x\s\S+, y\s\S+, z\s\S+\sm"))
    expect(page.locator(".run .overlay canvas")).to_have_attribute("height", "100")  # without its caption
    assert in_both_themes(page) == NONE
    page.click(".run .overlay")
    expect(page.locator("dialog.large canvas")).to_have_attribute("height", "152")
    page.keyboard.press("Escape")
    page.click(".run a")
    expect(page.locator("#in-image-facts")).to_contain_text("Distance, m")
    expect(page.locator("#in-image-picture canvas")).to_be_visible()
    page.get_by_text("Pose in the camera").click()
    camera = page.request.get(page.url.removesuffix("view") + "result").json()["camera"]
    shown = page.locator("#matrix tr").nth(2).locator("td").all_inner_texts()
    told = [float(text.replace("−", "-")) for text in shown]
    assert told == pytest.approx(camera["T_camera_object"]["matrix"][2], abs=1e-4)
    assert in_both_themes(page) == NONE
    page.goto(f"{service}/jobs")
    expect(page.locator(".tile")).to_contain_text("pixel 8, 6 in image depth")
    expect(page.locator(".tile .overlay canvas")).to_be_visible()
    assert [one for one in visit.complaints if not one.startswith(NETWORK)] == []
    assert [url for url in visit.requests if not url.startswith((service + "/", "blob:", "data:"))] == []


def test_a_recording_is_chosen_and_boxes_are_drawn_by_mouse_and_keys(
    visit: Visit, service: str, files: Files, tmp_path: Path
) -> None:
    page = visit.page
    answer = httpx.post(f"{service}/recordings", params={"label": "hall"}, content=stored(tmp_path / "r.safetensors"),
                        headers={"Content-Type": "application/octet-stream"})  # fmt: skip
    address = f"{service}/recordings/{answer.json()['sha256']}"
    eventually(lambda: httpx.get(address).json()["state"] == "ready", "the recording")
    open_page(page, service)
    page.set_input_files("#object-file", files[2])
    page.select_option("#scene-known", label="hall")
    page.wait_for_selector("html[data-scene]")
    page.get_by_role("button", name="Frame b").click()
    expect(page.locator("#sheet")).to_have_attribute("aria-label", "The picture of frame b")
    page.mouse.move(*at(page, 4.0, 3.0))
    page.mouse.down()
    page.mouse.move(*at(page, 12.0, 9.0), steps=3)
    page.mouse.up()
    expect(page.locator("#boxes button").first).to_have_text("Mark 1: box of 8 × 6 pixels in b")
    page.get_by_role("button", name="Right bottom corner").focus()
    page.keyboard.press("ArrowLeft")
    expect(page.locator("#boxes button").first).to_have_text("Mark 1: box of 7 × 6 pixels in b")
    page.get_by_role("button", name="Move the box").focus()
    for _ in range(9):
        page.keyboard.press("ArrowDown")  # no farther than the picture's edge
    expect(page.locator("#marks .edited")).to_have_attribute("y", "6")
    page.get_by_role("button", name="Frame a").click()
    expect(page.locator("#marks .edited")).to_have_count(0)
    page.click("#add-box")
    page.locator("#sheet").focus()
    for key in ("ArrowRight", "Shift+ArrowUp", "Enter"):
        page.keyboard.press(key)
    expect(page.locator("#boxes li").nth(1)).to_contain_text(re.compile("Mark 2: pixel 8, [56]"))
    page.get_by_role("button", name="Remove mark 2").click()
    page.locator("#boxes button").first.click()
    expect(page.locator("#sheet")).to_have_attribute("aria-label", "The picture of frame b")
    page.click("#register")
    detection = request_of_the_run(page)["detection"]
    (seen,) = [detection] if isinstance(detection, dict) else detection
    assert (seen["frame"], seen["box_2d"]) == ("b", pytest.approx([4.0, 6.0, 11.0, 12.0], abs=0.1))
    page.set_viewport_size({"width": 390, "height": 740})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.set_viewport_size({"width": VIEWPORT[0], "height": VIEWPORT[1]})
    page.goto(f"{service}/fields")
    hall = page.locator(".tile", has_text="hall")
    expect(hall).to_contain_text("2 frames")
    hall.get_by_role("button", name="Delete").click()
    page.locator("dialog[open]").get_by_role("button", name="Delete").click()
    expect(page.locator(".tile", has_text="hall")).to_have_count(0)
    assert httpx.get(address).status_code == 404
    assert [one for one in visit.complaints if not one.startswith(NETWORK)] == []


KINDS = """async (files) => {
  const { sorted } = await import('/static/js/frame-files.js');
  const made = files.map(([name, bytes]) => new File([new Uint8Array(bytes)], name));
  const found = await sorted(made);
  return Object.fromEntries(Object.entries(found).map(([kind, of]) => [kind, of.name ?? of.map(({ name }) => name)]));
}"""
PACKED = """async () => {
  const { archiveOf, namesIn } = await import('/static/js/archive.js');
  const long = `${'deep/'.repeat(30)}b.png`;
  const made = archiveOf('seq', [['depth/1.png', 'one'], [long, ''], ['a.txt', 'x'.repeat(600)]]
    .map(([path, text]) => ({ path, file: new File([text], 'name') })));
  const packed = new Response(made.stream().pipeThrough(new CompressionStream('gzip'))).blob();
  return [[...new Uint8Array(await made.arrayBuffer())], await namesIn(made), await namesIn(await packed)];
}"""
MOVED = """async (table) => {
  const { moved } = await import('/static/js/mark-handles.js');
  return table.map((each) => moved(...each, [16, 12]));
}"""
RUN = archive(model_ckpt=b"x", loss_png=b"y")


@pytest.mark.parametrize(
    ("files", "found"),
    [
        ({"d.png": DEPTH, "c.png": COLOR, "cat.stl": b"solid cat facet"},
         {"depth": "d.png", "color": "c.png", "rest": ["cat.stl"]}),
        ({"k.json": b'{"K": [1]}', "truth.json": b"{}", "mask.png": MASK, "x.json": b"{}"},
         {"camera": "k.json", "mask": "mask.png", "rest": []}),
        ({"1.png": DEPTH, "2.png": DEPTH, "1.txt": b"1 0 0 0"}, {"recording": "frames", "rest": []}),
        ({"a.zip": archive(depth_png=DEPTH, camera_json=b"{}"), "b.glb": b"glTF"},
         {"recording": "a.zip", "rest": ["b.glb"]}),
        ({"d.npy": b"\x93NUMPY\x01\0v\0{'descr': '<f4', 'shape': (12, 16), }", "camera.yaml": b"k: 1", "run.yaml": b""},
         {"depth": "d.npy", "settings": "camera.yaml", "rest": ["run.yaml"]}),
        ({"run.zip": RUN, "log.mcap": b"\x89MCAP0\r\n"}, {"recording": "log.mcap", "rest": ["run.zip"]}),
    ],
)  # fmt: skip
def test_files_are_told_apart_by_their_first_bytes(
    visit: Visit, service: str, files: dict[str, bytes], found: dict[str, Any]
) -> None:
    open_page(visit.page, service)
    assert visit.page.evaluate(KINDS, [[name, [*data]] for name, data in files.items()]) == found


def test_a_folder_becomes_an_archive_and_corners_stay_in_their_order(visit: Visit, service: str) -> None:
    page = visit.page
    open_page(page, service)
    data, names, packed = page.evaluate(PACKED)
    with tarfile.open(fileobj=io.BytesIO(bytes(data))) as made:
        assert {one.name: one.size for one in made} == {"a.txt": 600, f"{'deep/' * 30}b.png": 0, "depth/1.png": 3}
    assert names == packed
    assert names[-1] == "depth/1.png"
    table = [
        [[5, 5], [0, 1], [20, -20]],
        [[1, 2, 9, 10], [0, 1, 2, 3], [-4, 9]],
        [[1, 2, 9, 10], [2, 3], [-20, 1]],
        [[1, 2, 9, 10], [0, 3], [20, 20]],
    ]
    assert page.evaluate(MOVED, table) == [[16, 0], [0, 4, 8, 12], [1, 2, 3, 11], [7, 2, 9, 12]]
