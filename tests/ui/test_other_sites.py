"""Pages of other sites in a real browser: they try what pages can do to a service on this machine, and get nothing."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from regnf_state.ownership import ANONYMOUS
from regnf_state.records import JobRecord
from regnf_state.settings import Settings
from tests.ui.conftest import ARGUMENTS
from tests.ui.fixture_server import FixtureServer
from tests.ui.synthetic import JOB_ID
from tests.ui.test_real_app import OBJECT, SCENE, RealService, real_service

pytestmark = pytest.mark.browser
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
    setTimeout(() => done([tag, path, 'silent']), 3000);
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


@contextmanager
def evil_site() -> Iterator[int]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), _EvilPage)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@pytest.fixture(scope="module")
def misled(browser: Browser) -> Iterator[Browser]:
    """A browser for which two names of strangers lead to this machine."""
    kind = browser.browser_type
    launched = kind.launch(executable_path=browser_path(), args=[*ARGUMENTS, RULES])
    yield launched
    launched.close()


def browser_path() -> str:
    found = shutil.which("chromium") or shutil.which("chromium-browser")
    assert found is not None
    return found


@pytest.fixture
def page(misled: Browser) -> Iterator[Page]:
    context = misled.new_context()
    yield context.new_page()
    context.close()


@pytest.fixture
def service(server: FixtureServer) -> Iterator[RealService]:
    with real_service(server.stage.data.detection, Settings()) as started:
        yield started


def assert_untouched(service: RealService) -> None:
    """The job waits as it did, and there is nothing else."""
    (job,) = service.records.list_jobs(None, 10, None, ANONYMOUS).records
    assert isinstance(job, JobRecord)
    assert (job.id, job.status, job.cancel_requested) == (JOB_ID, "accepted", False)
    assert {field.sha256 for field in service.records.list_fields(None, 10, None, ANONYMOUS).records} == {SCENE, OBJECT}


def port_of(service: RealService) -> str:
    return service.origin.rpartition(":")[2]


def test_a_page_of_another_site_changes_and_reads_nothing(page: Page, service: RealService) -> None:
    """The last two share the service's name or address: only the port tells them apart."""
    with evil_site() as port:
        for name in (EVIL, "localhost", "127.0.0.1"):
            page.goto(f"http://{name}:{port}/")
            target = [service.origin, JOB_ID, SCENE]
            told = page.evaluate(WRITES, target)
            assert [(what, kind) for what, kind, _ in told if kind != "blocked"] == [], name
            loaded = [entry for entry in page.evaluate(INCLUDED, target) if entry[2] == "loaded"]
            assert [entry for entry in loaded if entry[0] in ("img", "script", "link")] == [], name
            page.goto("about:blank")
            assert_untouched(service)


def test_a_form_of_another_site_is_refused(page: Page, service: RealService) -> None:
    with evil_site() as port:
        for path in ("/register", "/fields", f"/jobs/{JOB_ID}/cancel"):
            for kind in ("application/x-www-form-urlencoded", "multipart/form-data", "text/plain"):
                page.goto(f"http://{EVIL}:{port}/")
                with page.expect_navigation() as answer:
                    page.evaluate(FORM, [service.origin + path, kind])
                assert answer.value.status == 403, (path, kind)
        page.goto("about:blank")
    assert_untouched(service)


def test_the_page_is_shown_in_no_frame_but_a_link_leads_to_it(page: Page, service: RealService) -> None:
    with evil_site() as port:
        page.goto(f"http://{EVIL}:{port}/")
        with page.expect_response(service.view) as answer:
            page.evaluate(
                "(url) => document.body.append(Object.assign(document.createElement('iframe'), {src: url}))",
                service.view,
            )
        assert answer.value.status == 403
        page.evaluate("(url) => { location.href = url; }", service.view)
        expect(page.locator("#message-title")).to_have_text("In the queue", timeout=30_000)
        assert page.evaluate("window.opener === null")
        page.goto("about:blank")


def test_a_name_that_is_made_to_lead_here_opens_nothing(page: Page, service: RealService) -> None:
    """What a page can do once its own name leads here (DNS rebinding): to the browser it is the same site."""
    origin = f"http://{REBOUND}:{port_of(service)}"
    landed: Any = page.goto(f"{origin}/fields")
    assert landed.status == 421
    script = """async (calls) => Promise.all(calls.map(([method, path]) =>
        fetch(path, {method}).then((answer) => answer.status, () => 421)))"""
    calls = [["GET", "/fields"], ["DELETE", f"/fields/{SCENE}"], ["POST", f"/jobs/{JOB_ID}/cancel"], ["GET", "/jobs"]]
    calls += [["GET", f"/fields/{SCENE}/preview.png"], ["PUT", f"/fields/{SCENE}"], ["DELETE", f"/jobs/{JOB_ID}"]]
    assert set(page.evaluate(script, calls)) == {421}
    page.goto("about:blank")
    assert_untouched(service)
