"""Pages of other sites in a real browser: they try what pages can do to a service on this machine, and get nothing."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, NamedTuple

import pytest
from playwright.sync_api import Browser, Page, expect

from regnf_state.ownership import ANONYMOUS
from regnf_state.records import FieldRecord, JobRecord
from regnf_state.redis.jobs import RecordStore
from regnf_state.settings import Settings
from tests.stores import private_stores
from tests.ui.conftest import ARGUMENTS, chromium
from tests.ui.home import served
from tests.ui.stories import field_picture
from tests.ui.synthetic import JOB_ID, synthetic

pytestmark = pytest.mark.browser
SCENE, OBJECT = "a3" * 32, "7c" * 32


class RealService(NamedTuple):
    origin: str
    records: RecordStore

    @property
    def view(self) -> str:
        return f"{self.origin}/jobs/{JOB_ID}/view"


@pytest.fixture(scope="module")
def service() -> Iterator[RealService]:
    """The application on a port of its own, with one accepted job and its two fields in its store."""
    with private_stores() as stores, served(Settings(), stores) as origin:
        now, inputs = time.time(), {"scene": SCENE, "object": OBJECT, "seed": 7, "detection": synthetic().detection}
        stores.records.create_job(JobRecord(JOB_ID, "registration", "accepted", {"scene": SCENE}, inputs, now, now), 10)
        for sha256 in (SCENE, OBJECT):
            stores.records.create_field(FieldRecord(sha256, "ready", 1, now, now))
            stores.blobs.put(f"fields/{sha256}/preview.png", field_picture(sha256))
        yield RealService(origin, stores.records)


EVIL, REBOUND = "evil.example", "rebound.example"
RULES = f"--host-resolver-rules=MAP {EVIL} 127.0.0.1, MAP {REBOUND} 127.0.0.1, MAP localhost 127.0.0.1"
WRITES = """async ([origin, job, scene]) => {
  const told = [];
  const send = async (name, path, options) => {
    try { const answer = await fetch(origin + path, options); told.push([name, answer.type, answer.status]); }
    catch (error) { told.push([name, 'blocked', 0]); }
  };
  const form = new FormData();
  form.append('request', '{"detection": {"min": [0,0,0], "max": [1,1,1]}}');
  form.append('scene', new Blob(['solid x']), 'scene'); form.append('object', new Blob(['solid y']), 'object');
  const header = '{"__metadata__": {"name": "evil"}}';
  const field = new Blob([new Uint8Array([header.length, 0, 0, 0, 0, 0, 0, 0]), header, new Uint8Array(600)]);
  await send('register', '/register', {method: 'POST', mode: 'no-cors', body: form});
  await send('upload', '/fields', {method: 'POST', mode: 'no-cors', body: field});
  await send('cancel', `/jobs/${job}/cancel`, {method: 'POST', mode: 'no-cors', body: 'x'});
  await send('delete', `/fields/${scene}`, {method: 'DELETE'});
  await send('delete job', `/jobs/${job}`, {method: 'DELETE'});
  await send('read', '/fields', {mode: 'cors'});
  await send('read blindly', '/fields', {mode: 'no-cors'});
  navigator.sendBeacon(`${origin}/jobs/${job}/cancel`, 'x');
  return told;
}"""
INCLUDED = """([origin, job, scene]) => Promise.all([
    ['img', `/fields/${scene}/preview.png`], ['script', '/static/js/app.js'], ['script', `/jobs/${job}`],
    ['link', '/static/css/base.css'], ['object', `/jobs/${job}/view`], ['embed', '/docs'],
  ].map(([tag, path]) => new Promise((done) => {
    const node = document.createElement(tag);
    node.onload = () => done([tag, path, 'loaded']);
    node.onerror = () => done([tag, path, 'refused']);
    if (tag === 'link') { node.rel = 'stylesheet'; node.href = origin + path; }
    else if (tag === 'object') node.data = origin + path;
    else node.src = origin + path;
    document.body.append(node);
    if (tag === 'object' || tag === 'embed') setTimeout(() => done([tag, path, 'silent']), 1000);
  })))"""
FORM = """([action, kind]) => {
  const form = document.createElement('form');
  Object.assign(form, {action, method: 'post', enctype: kind});
  form.append(Object.assign(document.createElement('input'), {name: 'x', value: 'y'}));
  document.body.append(form);
  form.submit();
}"""


class _EvilPage(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><title>evil</title><body>")

    def log_message(self, *_: object) -> None:
        """Tests need no access log."""


@pytest.fixture(scope="module")
def evil_port() -> Iterator[int]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), _EvilPage)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    yield server.server_address[1]
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture(scope="module")
def misled(browser: Browser) -> Iterator[Browser]:
    """A browser for which two names of strangers lead to this machine."""
    launched = browser.browser_type.launch(executable_path=chromium(), args=[*ARGUMENTS, RULES])
    yield launched
    launched.close()


@pytest.fixture
def page(misled: Browser, service: RealService) -> Iterator[Page]:
    """In the end the job waits as it did, and there is nothing else."""
    context = misled.new_context()
    yield context.new_page()
    context.close()
    (job,) = service.records.list_jobs(None, 10, None, ANONYMOUS).records
    assert isinstance(job, JobRecord)
    assert (job.id, job.status, job.cancel_requested) == (JOB_ID, "accepted", False)
    assert {field.sha256 for field in service.records.list_fields(None, 10, None, ANONYMOUS).records} == {SCENE, OBJECT}


def test_a_page_of_another_site_changes_and_reads_nothing(page: Page, service: RealService, evil_port: int) -> None:
    """The last two share the service's name or address: only the port tells them apart."""
    for name in (EVIL, "localhost", "127.0.0.1"):
        page.goto(f"http://{name}:{evil_port}/")
        target = [service.origin, JOB_ID, SCENE]
        told = page.evaluate(WRITES, target)
        assert [(what, kind) for what, kind, _ in told if kind != "blocked"] == [], name
        loaded = [entry for entry in page.evaluate(INCLUDED, target) if entry[2] == "loaded"]
        assert [entry for entry in loaded if entry[0] in ("img", "script", "link")] == [], name


def test_a_form_of_another_site_is_refused(page: Page, service: RealService, evil_port: int) -> None:
    kinds = ("application/x-www-form-urlencoded", "multipart/form-data", "text/plain")
    for path, kind in zip(("/register", "/fields", f"/jobs/{JOB_ID}/cancel"), kinds, strict=True):
        page.goto(f"http://{EVIL}:{evil_port}/")
        with page.expect_navigation() as answer:
            page.evaluate(FORM, [service.origin + path, kind])
        assert answer.value.status == 403, (path, kind)


def test_the_page_is_shown_in_no_frame_but_a_link_leads_to_it(page: Page, service: RealService, evil_port: int) -> None:
    page.goto(f"http://{EVIL}:{evil_port}/")
    framed = "(url) => document.body.append(Object.assign(document.createElement('iframe'), {src: url}))"
    with page.expect_response(service.view) as answer:
        page.evaluate(framed, service.view)
    assert answer.value.status == 403
    page.evaluate("(url) => { location.href = url; }", service.view)
    expect(page.locator("#message-title")).to_have_text("In the queue", timeout=30_000)
    assert page.evaluate("window.opener === null")


def test_a_name_that_is_made_to_lead_here_opens_nothing(page: Page, service: RealService) -> None:
    """What a page can do once its own name leads here (DNS rebinding): to the browser it is the same site."""
    origin = f"http://{REBOUND}:{service.origin.rpartition(':')[2]}"
    landed: Any = page.goto(f"{origin}/fields")
    assert landed.status == 421
    script = """async (calls) => Promise.all(calls.map(([method, path]) =>
        fetch(path, {method}).then((answer) => answer.status, () => 421)))"""
    calls = [["GET", "/fields"], ["DELETE", f"/fields/{SCENE}"], ["POST", f"/jobs/{JOB_ID}/cancel"], ["GET", "/jobs"]]
    calls += [["GET", f"/fields/{SCENE}/preview.png"], ["PUT", f"/fields/{SCENE}"], ["DELETE", f"/jobs/{JOB_ID}"]]
    assert set(page.evaluate(script, calls)) == {421}
