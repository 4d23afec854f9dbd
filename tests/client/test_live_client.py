"""The client with a real service and its worker: from files to poses and pictures; batches, and the library."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from regnf_client import AsyncClient, Client, Pair, Result, ServiceError, WaitTimeoutError
from tests.client.transports import Counted
from tests.contract.live import Live, eventually
from tests.devdata import ROOT
from tests.live_stack import DATA, LIVE, QUICK

pytestmark = LIVE
FAR = {"min": [50, 50, 50], "max": [51, 51, 51]}
UPRIGHT = {"up_axis": "z"}
ROOM, CHAIR = DATA / "mix-room.safetensors", DATA / "armchair.safetensors"
BOX = json.loads((DATA / "detection.json").read_text())
TRUTH = np.array(json.loads((DATA / "truth.json").read_text())["T_object_scene"]["matrix"])


@pytest.fixture
def client(live_stack: Live) -> Iterator[Client]:
    with Client(live_stack.address) as made:
        yield made


@pytest.fixture(scope="module")
def found(live_stack: Live) -> Result:
    """The demo's registration."""
    with Client(live_stack.address) as made:
        return made.register(ROOM, CHAIR, BOX, UPRIGHT, seed=4711)


def test_a_pose_from_files(found: Result) -> None:
    assert (found.verdict, found.level) == ("registered", "strict")
    assert "(strict)" in repr(found)
    assert np.abs(found.T_object_scene - TRUTH).max() < 0.01
    assert found.scale == pytest.approx(float(np.cbrt(np.linalg.det(TRUTH[:3, :3]))), rel=0.002)
    point = np.array([[0.1, 0.2, 0.3]])
    assert np.allclose(found.apply(point), point @ TRUTH[:3, :3].T + TRUTH[:3, 3], atol=0.01)
    assert np.allclose(found.T_scene_object @ found.T_object_scene, np.eye(4), atol=1e-9)
    assert (np.shape(found.covariance), found.source) == ((7, 7), str(CHAIR))


def test_fields_that_the_service_has_are_not_sent(live_stack: Live, found: Result) -> None:
    counted = Counted(httpx.HTTPTransport())
    with Client(live_stack.address, transport=counted) as client:
        again = client.register(ROOM, CHAIR, BOX, UPRIGHT, seed=4711)
    assert again.job == found.job
    assert counted.bytes < 10_000


def test_what_a_box_may_be(client: Client) -> None:
    low, high = np.array(BOX["center"]) - np.array(BOX["size"]) / 2, np.array(BOX["center"]) + np.array(BOX["size"]) / 2
    jobs = [client.submit(ROOM, CHAIR, box, QUICK) for box in (BOX, (low, high), {"min": low, "max": high})]
    assert len({job.id for job in jobs[1:]}) == 1
    assert all(client.wait(job).finished for job in jobs[:2])


def test_files_of_a_result(client: Client, found: Result, tmp_path: Path) -> None:
    paths = client.save(found, tmp_path / "out")
    assert {path.name for path in paths} == {one.name for one in found.artifacts}
    assert np.allclose(np.load(tmp_path / "out" / "T_scene_object.npy"), found.T_scene_object)
    assert client.artifact(found, "preview.png").startswith(b"\x89PNG")
    assert not list((tmp_path / "out").glob("*.part"))
    with pytest.raises(ServiceError) as caught:
        client.artifact(found, "nothing.png")
    assert (caught.value.status, caught.value.reason) == (404, "ARTIFACT_NOT_FOUND")


def test_a_download_goes_on_where_it_stopped(live_stack: Live, found: Result, tmp_path: Path) -> None:
    ranges: list[str | None] = []

    class Breaks(httpx.HTTPTransport):
        def handle_request(self, request: httpx.Request) -> httpx.Response:
            answer = super().handle_request(request)
            if not answer.is_success:
                return answer  # the file is not made yet: asked again
            ranges.append(request.headers.get("range"))
            if len(ranges) > 1:
                return answer
            start = answer.read()[:1000]
            answer.close()
            return httpx.Response(200, stream=_BrokenStream(start), request=request)

    with Client(live_stack.address, transport=Breaks()) as client:
        path = client.download(found, "aligned.ply", tmp_path / "aligned.ply")
    with Client(live_stack.address) as client:  # the file was made after the result
        whole = {one.name: one for one in client.result(found).artifacts}["aligned.ply"]
    assert path.stat().st_size == whole.bytes
    assert ranges == [None, "bytes=1000-"]


class _BrokenStream(httpx.SyncByteStream):
    def __init__(self, start: bytes) -> None:
        self._start = start

    def __iter__(self) -> Iterator[bytes]:
        yield self._start
        raise httpx.ReadError("the connection broke")


def test_events_as_they_come(client: Client) -> None:
    job = client.submit(ROOM, CHAIR, BOX, UPRIGHT, seed=4712)
    events = list(client.watch(job))
    assert events[-1].data["status"] == "successful"
    assert {event.name for event in events} == {"status", "progress"}
    told, result = client.job(job), client.result(job)
    assert (told.verdict, told.probability, told.level) == (result.verdict, result.probability, "strict")
    assert job.id in {one.id for one in client.jobs("successful")}


def test_searches_and_batches_of_one_scene(client: Client) -> None:
    ranked = client.search(ROOM, [ROOM, CHAIR], BOX, UPRIGHT)
    assert ranked.candidates is not None
    assert ranked.source == ranked.candidates[0].source == str(CHAIR)
    assert {one.source for one in ranked.candidates} == {str(ROOM), str(CHAIR)}
    outcomes = client.register_batch(ROOM, [BOX, FAR], [CHAIR], options=UPRIGHT, seed=4713)
    assert [(one.detection, one.object) for one in outcomes] == [(0, 0), (1, 0)]
    assert [one.result is None for one in outcomes] == [False, True]
    assert [one.error and one.error.reason for one in outcomes] == [None, "DETECTION_OUTSIDE_SCENE"]


def test_a_rendering(client: Client, found: Result) -> None:
    edits = [{"kind": "substitution", "job": found}]
    made = client.render(ROOM, edits, {"orbit": {"edit": 0, "frames": 1}, "size": (32, 24), "outputs": ["color"]})
    assert (made.frames, made.size) == (1, (32, 24))
    assert client.artifact(made, made.artifacts[0].name)


def test_a_job_can_be_cancelled_and_started_anew(client: Client) -> None:
    request = {**QUICK, "optimization": {"iterations": 10_000, "stop_residual": 0.0}}
    job = client.submit(ROOM, CHAIR, BOX, request, seed=4714)
    client.cancel(job)
    assert client.wait(job).status == "dismissed"
    with pytest.raises(ServiceError):
        client.result(job)
    assert client.submit(ROOM, CHAIR, BOX, request, seed=4714).id == job.id
    with pytest.raises(WaitTimeoutError, match="has not ended within"):
        client.wait(job, timeout_s=0.0)
    client.cancel(job)


def test_the_same_to_be_awaited(live_stack: Live, found: Result, tmp_path: Path) -> None:
    async def program() -> None:
        async with AsyncClient(live_stack.address) as client:
            again, other = await asyncio.gather(
                client.register(ROOM, CHAIR, BOX, UPRIGHT, seed=4711),
                client.register(ROOM, CHAIR, BOX, UPRIGHT, seed=4715),
            )
            assert (again.job, other.seed) == (found.job, 4715)
            events = [event async for event in client.watch(other)]
            assert events[-1].data["status"] == "successful"
            path = await client.download(again, "T_scene_object.npy", tmp_path / "T.npy")
            assert np.allclose(np.load(path), found.T_scene_object)
            with pytest.raises(ServiceError, match="job"):
                await client.job("nothing")

    asyncio.run(program())


def test_files_in_results_out(live_stack: Live) -> None:
    pairs = [Pair(ROOM, CHAIR, BOX, UPRIGHT, seed=5100 + number, key=str(number)) for number in range(2)]
    with Client(live_stack.address) as client:
        found = {one.key: one for one in client.batch([*pairs, Pair(ROOM, CHAIR, FAR, key="far")], timeout_s=250)}
        whole = client.result(found["0"])  # type: ignore[arg-type]
    assert {found[str(number)].status for number in range(2)} == {"successful"}
    assert found["far"].error is not None
    assert found["far"].error.reason == "DETECTION_OUTSIDE_SCENE"
    np.testing.assert_array_equal(found["0"].T_object_scene, whole.T_object_scene)  # type: ignore[arg-type]
    assert found["0"].verdict == whole.verdict


def test_the_pipeline_sorts_what_comes_back(live_stack: Live, tmp_path: Path) -> None:
    (tmp_path / "data").symlink_to(DATA)
    pair: dict[str, Any] = {"scene": "data/mix-room.safetensors", "object": "data/armchair.safetensors"}
    lines = [
        {**pair, "key": "good", "detection": BOX, "options": {"up_axis": "z"}, "seed": 4711},
        {**pair, "key": "far", "detection": FAR},
    ]
    (tmp_path / "pairs.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    example = ROOT / "examples" / "05_pipeline.py"
    command = [sys.executable, str(example), live_stack.address, str(tmp_path / "pairs.jsonl"), str(tmp_path / "out")]
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True, timeout=250, check=False)
        assert done.returncode == 0, done.stderr
        assert done.stdout == "1 in failed.jsonl, 1 in used.jsonl\n"
    (used,) = map(json.loads, (tmp_path / "out" / "used.jsonl").read_text().splitlines())
    (failed,) = map(json.loads, (tmp_path / "out" / "failed.jsonl").read_text().splitlines())
    assert (used["key"], len(used["poses"][0])) == ("good", 4)
    assert (failed["key"], failed["reason"]) == ("far", "DETECTION_OUTSIDE_SCENE")


def test_a_worker_finds_an_entrys_symmetry(live_stack: Live, tmp_path: Path) -> None:
    with Client(live_stack.address) as client:
        made = client.library.add("a dining chair", DATA / "dining-chair.safetensors", ["seat"])
        found = eventually(lambda: client.library.get(made.name).symmetry, "the symmetry of the entry", 120)
        assert found == {"order": 1, "axis": None, "continuous": False}
        assert client.library.get(made.name).symmetry_source == "detected"
        carried = client.library.download(made.name, tmp_path / "chair.safetensors")
        assert carried.read_bytes()[8:9] == b"{"
        client.library.remove(made.name)
