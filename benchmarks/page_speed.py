"""The home page with a large scene, without a GPU: seconds to the first picture, and frames a second while it turns.

    python -m benchmarks.page_speed [--triangles 1000000] [--turns 3] [--output benchmarks/results/page_speed.md]

A room's mesh with so many triangles is uploaded to a service of its own. Chromium draws in software (SwiftShader) at
1280 x 800; the mouse drags the view for four seconds, some times. A frame is a display frame in which something was
drawn.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import trimesh
from playwright.sync_api import Page, sync_playwright

from benchmarks.service_load.report import headed, load, write
from regnf_cli.demo import running_service
from tests.ui.conftest import ARGUMENTS
from tests.ui.room import room

_DRAG_S = 4.0
_SETTLED_S = 1.0
"""In this time after its start a movement finds out how much it may draw."""
_SIZE = {"width": 1280, "height": 800}
_COUNT_FRAMES = """
window.drawnAt = [];
let drawn = false;
for (const name of ['drawElements', 'drawArrays']) {
  const draw = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...given) { drawn = true; return draw.apply(this, given); };
}
const look = (now) => {
  if (drawn) window.drawnAt.push(performance.now());
  drawn = false;
  requestAnimationFrame(look);
};
requestAnimationFrame(look);
new MutationObserver(() => {
  if (document.documentElement.dataset.scene) window.sceneAt ??= performance.now();
}).observe(document, { attributes: true, subtree: true, attributeFilter: ['data-scene'] });
"""
_SHOWN = "() => window.drawnAt.find((at) => at >= window.sceneAt)"
"""Milliseconds from the start of the navigation to the first frame with the scene in it."""


def large_room(triangles: int) -> bytes:
    """A room as binary PLY, its triangles divided until there are so many."""
    mesh = room()
    while len(mesh.faces) < triangles:
        mesh = mesh.subdivide()
    data: bytes = trimesh.exchange.ply.export_ply(mesh)
    return data


def upload(address: str, data: bytes) -> str:
    """The field's SHA-256, once its mesh has been made."""
    with httpx.Client(base_url=address, timeout=600) as client:
        sha256 = str(client.post("/fields", content=data).raise_for_status().json()["sha256"])
        while (field := client.get(f"/fields/{sha256}", params={"wait": 30}).json()).get("views") != "ready":
            if field["state"] == "rejected" or field.get("views") == "none":
                raise RuntimeError(f"no mesh to look at: {field['error']}")
            time.sleep(1.0)
    return sha256


@contextmanager
def opened(address: str) -> Iterator[Page]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        page = browser.new_page(viewport=_SIZE)  # type: ignore[arg-type]
        page.add_init_script(_COUNT_FRAMES)
        page.goto(address)
        yield page
        browser.close()


def drag(page: Page) -> tuple[float, float]:
    """Frames a second of one movement: from its start on, and once it has settled."""
    box = page.locator("#canvas").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.wait_for_timeout(2000)  # what was drawn before is over
    page.mouse.move(x, y)
    page.mouse.down()
    began, start = time.monotonic(), page.evaluate("performance.now()")
    step = 0
    while time.monotonic() < began + _DRAG_S:
        step += 1
        page.mouse.move(x + 200 * (1 - abs((step % 200) / 100 - 1)), y)
    end = page.evaluate("performance.now()")
    page.mouse.up()
    times = [at for at in page.evaluate("window.drawnAt") if start <= at <= end]
    settled = [at for at in times if at >= start + 1000 * _SETTLED_S]
    return len(times) / (end - start) * 1000, len(settled) / (end - start - 1000 * _SETTLED_S) * 1000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--triangles", type=int, default=1_000_000)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    before, data = load(), large_room(arguments.triangles)
    with tempfile.TemporaryDirectory(prefix="regnf-") as name, running_service(Path(name)) as address:
        sha256 = upload(address, data)
        with opened(f"{address}/?scene={sha256}") as page:
            shown = page.wait_for_function(_SHOWN, timeout=120_000).json_value() / 1000.0
            turns = [drag(page) for _ in range(arguments.turns)]
    rows = [
        f"| first picture of the scene after opening the address | {shown:.1f} s |",
        *(f"| movement {i}: frames a second, after the first second | {all_:.0f}, {then:.0f} |"
          for i, (all_, then) in enumerate(turns, 1)),
    ]  # fmt: skip
    asked = f"--triangles {arguments.triangles} --turns {arguments.turns}"
    text = headed(f"python -m benchmarks.page_speed {asked}", [before, load()], ["| | |", "|---|---|", *rows])
    write("The home page with a large scene", text, arguments.output)


if __name__ == "__main__":
    main()
