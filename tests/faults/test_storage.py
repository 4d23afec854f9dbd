"""A storage that is away, hangs, or is full. The first line of each test says what the service makes of it."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.contract.world import field_bytes, sha256
from tests.faults.conftest import house_over
from tests.faults.house import House
from tests.faults.promise import check_promise, fault, leftovers
from tests.faults.proxy import Proxy, to_port
from tests.faults.stores import Bucket, Folder
from tests.object_store import ObjectServer
from tests.restartable_redis import RestartableRedis, restartable_redis
from tests.worker.bench import eventually

pytestmark = pytest.mark.long
MIB = 1 << 20


def outlive(house: House, go_away: Callable[[], None], come_back: Callable[[], None]) -> int:
    """The storage is away while a job ends and callers come. How many attempts the job took."""
    _, worker = house.start_both()
    job_id, request, field = house.running(), house.request(seed=9), field_bytes("another")
    with fault() as one:
        begun = time.monotonic()
        go_away()
        house.let_go()
        for answer in (
            house.client.post("/register", json=request),
            house.client.put(f"/fields/{sha256(field)}", content=field),
        ):
            assert (answer.status_code, answer.json()["reason"]) == (503, "STORAGE_UNAVAILABLE"), answer.text
            assert "Retry-After" in answer.headers
        assert house.client.get("/readyz").json()["checks"] == {"records": True, "storage": False, "worker": True}
        assert house.job(job_id)["status"] in ("running", "accepted")
        time.sleep(max(0.0, begun + house.pace.lasting(0.0, 60.0) - time.monotonic()))
        come_back()
        one.over()
        assert house.finished(job_id)["status"] == "successful", house.log()
        again = house.client.post("/register", json=request)
        assert again.status_code in (200, 202), again.text
        house.upload(field)
        done = check_promise(house, [job_id, again.json()["id"]])
    assert worker.poll() is None
    return int(done[job_id]["attempts"])


def test_an_object_store_that_hangs(house: House, objects: ObjectServer) -> None:
    """Calls that need it are told 503 after ten seconds; a job that runs waits for two minutes with its result."""
    assert outlive(house, objects.freeze, objects.thaw) == 1


def test_an_object_store_that_is_away(tmp_path: Path, objects: ObjectServer, server: RestartableRedis) -> None:
    """The same as when it hangs."""
    with Proxy(to_port(objects.port)) as network:
        store = Bucket(objects, objects.new_bucket(), f"http://127.0.0.1:{network.port}")
        with house_over(tmp_path, server, store) as house:
            assert outlive(house, network.close, network.open) == 1


@pytest.mark.parametrize("gone", ["blobs", "."], ids=["of_results", "of_all_files"])
def test_a_volume_that_is_away(folder_house: House, gone: str) -> None:
    """The same, but a job that finds its files gone is run once more; nothing is written in the volume's place."""
    volume = folder_house.state("worker") / gone
    elsewhere = folder_house.folder / "elsewhere"

    def unmount() -> None:
        volume.rename(elsewhere)
        volume.mkdir()

    def mount() -> None:
        volume.rmdir()  # which fails if anything is in it
        elsewhere.rename(volume)

    assert outlive(folder_house, unmount, mount) in (1, 2)


# a volume that is full


@pytest.fixture
def small_house(tmp_path: Path) -> Iterator[House]:
    """A service whose files are all, those of Redis too, on a volume of 64 MiB. Skips where none can be mounted."""
    state = tmp_path / "state"
    state.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(state)]
    if shutil.which("mount") is None or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("no volume can be mounted here: what a full one does is not tested")
    try:
        with restartable_redis(state / "redis") as server, house_over(tmp_path, server, Folder(state)) as made:
            yield made
    finally:
        # a killed worker's child is killed by the system, which takes its time, and holds the volume until then
        eventually(lambda: subprocess.run(["umount", str(state)], capture_output=True, check=False).returncode == 0)


def fill(house: House, leave: int = 0) -> Path:
    """A file that leaves so many bytes on the volume."""
    filler = house.state("worker") / "filler"
    with filler.open("wb", buffering=0) as file:
        try:
            while shutil.disk_usage(filler).free > leave:
                file.write(bytes(min(MIB, max(4096, shutil.disk_usage(filler).free - leave))))
        except OSError:
            assert not leave
    return filler


def test_a_disk_that_fills_up_during_an_upload(small_house: House) -> None:
    """The upload is told 507 and leaves nothing; once there is room it is taken."""
    house = small_house
    house.start_both()
    before = house.submit()
    check_promise(house, [before])
    data = field_bytes("large", 12 * MIB)
    with fault() as one:
        filler = fill(house, leave=4 * MIB)
        answer = house.client.put(f"/fields/{sha256(data)}", content=data)
        assert (answer.status_code, answer.json()["reason"]) == (507, "STORAGE_FULL"), answer.text
        eventually(lambda: not leftovers(house), lambda: str(leftovers(house)))
        assert house.client.get(f"/fields/{sha256(data)}").status_code == 404
        filler.unlink()
        one.over()
        house.upload(data)
        eventually(lambda: house.field(sha256(data))["state"] == "ready", house.log)
        check_promise(house, [before, house.submit(1)])


def test_a_disk_that_fills_up_before_a_result(small_house: House) -> None:
    """The job has failed with STORAGE_FULL and leaves nothing; it is said once Redis, on the same disk, can write."""
    house = small_house
    _, worker = house.start_both()
    job_id = house.running()
    with fault() as one:
        filler = fill(house)
        house.let_go()
        time.sleep(house.pace.lasting(3.0, 60.0))
        filler.unlink()
        one.over()
        check_promise(house, [], {job_id: "STORAGE_FULL"})
        again = house.client.post("/register", json=house.request())
        assert (again.status_code, again.json()["id"]) == (202, job_id)
        check_promise(house, [job_id])
    assert worker.poll() is None
