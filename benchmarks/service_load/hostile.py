"""What one caller notices while another attacks: polls, a batch of three, uploads; and the front end's memory.

    python -m benchmarks.service_load.hostile [--seconds 15] [--connections 100] [--attacks NAME ...] [--output FILE]

A service with two workers and tokens for Alice, who attacks, Bob, who is timed, and Carol, who is asked whether the
service is ready. Each attack goes on, from a process of its own, for as long as Bob is timed. The bars are those of the
table; ends with status 1 where one of them does not hold. Needs cores that nothing else uses.

pages            many readers of the longest lists: jobs, fields, batches whose lines were refused
filters          a filter that finds nothing among a thousand fields; a status that no job has
results          results of a batch of 8,000 refused lines, by a status that none of them has
unread meshes    meshes that are asked for and not read
unread pages     the same of lists and of the contract
library batches  batches whose every line names a library of 500: some are accepted and cancelled, some are too long
batches          40 batches of fields that nobody has; others are posted, cancelled and deleted without a pause
requests         searches among 400 candidates, in bodies that come slowly and whole
webhooks         a receiver that sends a byte of its answer now and then, and one that never ends its head
pieces           uploads in pieces that are put together and turn out to be others than they were said to be
uploads          forms and files that are no field, as many as are taken
"""

from __future__ import annotations

import argparse
import asyncio
import hashlib
import json
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks.service_load.house import House, running_house
from benchmarks.service_load.report import headed, load, write
from benchmarks.service_load.small_fields import SmallPair, write_small_pair
from benchmarks.service_load.webhook_receiver import SECRET
from regnf_core.field_notes import MESH_NAMES, PICTURE_NAME
from regnf_core.library_entries import EntryNotes
from regnf_state.blobs.local import LocalBlobStore
from regnf_state.ownership import reference_of
from regnf_state.pieces import view_key
from regnf_state.records import FieldRecord
from regnf_state.redis.client import connect
from regnf_state.redis.jobs import RecordStore

_TOKENS = {name: f"token-of-{name}-for-the-benchmark" for name in ("alice", "bob", "carol")}
_NDJSON = {"Content-Type": "application/x-ndjson"}
_BOX = {"min": [-0.4, -0.3, 0.0], "max": [0.1, 0.2, 0.4]}
_FIELDS, _ENTRIES, _MESH_BYTES = 1000, 500, 4_600_000
_POLLERS = 4
_POLL_EVERY_S = 0.05
_SMALL = {"up_axis": "z", "robust": {"scene_samples": 800, "object_samples": 800, "feature_draws": 0}}
"""Options of small registrations: how long Bob waits is timed, not how long they compute."""
_POLL_MS, _BATCH_S, _UPLOAD_S, _MEMORY_MB = 100.0, 2.0, 0.5, 300.0
_numbers = count(1)


# Alice


class Alice:
    """The attacker: bare connections, so that hundreds of them cost her little."""

    def __init__(self, port: int, connections: int, told: dict[str, Any]) -> None:
        self.port, self.connections, self.told = port, connections, told
        self.answers: Counter[str] = Counter()

    def head(self, method: str, path: str, *more: str) -> bytes:
        lines = [
            f"{method} {path} HTTP/1.1",
            f"Host: 127.0.0.1:{self.port}",
            f"Authorization: Bearer {_TOKENS['alice']}",
        ]
        return "\r\n".join([*lines, *more, "", ""]).encode()

    async def ask(self, method: str, path: str, body: bytes = b"", kind: str = "application/json", *more: str) -> bytes:
        """One request on a connection of its own; what is answered."""
        more += (f"Content-Type: {kind}", f"Content-Length: {len(body)}") if method != "GET" else ()
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port)
        try:
            writer.write(self.head(method, path, "Connection: close", *more) + body)
            answer = await reader.read(1 << 16)
            self.answers[answer[9:12].decode("latin-1")] += 1
            while len(answer) < (1 << 16) and (more_of_it := await reader.read(1 << 16)):
                answer += more_of_it
            while await reader.read(1 << 16):
                pass
            return answer
        finally:
            writer.close()

    async def again_and_again(self, *paths: str) -> None:
        """All connections ask for these, each reading what is answered."""

        async def reader_of(path: str) -> None:
            while True:
                await self.ask("GET", path)

        await self.all_of(reader_of(paths[number % len(paths)]) for number in range(self.connections))

    async def unread(self, connections: int, *paths: str) -> None:
        """So many connections ask and do not read; those that are closed are made anew."""

        async def silent(path: str) -> None:
            while True:
                reader, writer = await asyncio.open_connection("127.0.0.1", self.port, limit=1024)
                self.answers["asked"] += 1
                writer.write(self.head("GET", path))
                while not writer.is_closing() and reader.exception() is None and not reader.at_eof():
                    await asyncio.sleep(0.5)
                self.answers["closed"] += 1
                writer.close()

        await self.all_of(silent(paths[number % len(paths)]) for number in range(connections))

    async def all_of(self, work: Iterator[Awaitable[None]]) -> None:
        """All of it at once; a connection that breaks is made anew a moment later."""

        async def one(task: Awaitable[None]) -> None:
            with suppress(OSError, asyncio.IncompleteReadError):
                await task

        await asyncio.gather(*map(one, work))

    async def post_batch(self, lines: Iterator[dict[str, Any] | str]) -> str | None:
        """The id of the batch."""
        text = "\n".join(line if isinstance(line, str) else json.dumps(line) for line in lines)
        answer = await self.ask("POST", "/batches", text.encode(), _NDJSON["Content-Type"])
        body = answer.partition(b"\r\n\r\n")[2]
        return json.loads(body).get("id") if body.startswith(b"{") else None


async def pages(alice: Alice) -> None:
    for number in range(100):
        await alice.post_batch(f"refused {number} {line}" for line in range(40))
    await alice.again_and_again("/batches?limit=100", "/jobs?limit=200", "/fields?limit=200")


async def filters(alice: Alice) -> None:
    await alice.again_and_again("/fields?label=nope", "/jobs?status=failed", "/library?tag=nope")


async def results(alice: Alice) -> None:
    batch = await alice.post_batch(f"refused {line}" for line in range(8000))
    await alice.again_and_again(f"/batches/{batch}/results?status=successful")


async def unread_meshes(alice: Alice) -> None:
    await alice.unread(5 * alice.connections, *(f"/fields/{name}/mesh.glb" for name in alice.told["fields"]))


async def unread_pages(alice: Alice) -> None:
    await alice.unread(5 * alice.connections, "/fields?limit=200", "/openapi.yaml", "/openapi.json")


async def library_batches(alice: Alice) -> None:
    request = {"scene": alice.told["scene"], "detection": _BOX, "candidates": {"library": {}}}

    async def batches(lines: int) -> None:
        while True:
            if batch := await alice.post_batch(request | {"seed": next(_numbers)} for _ in range(lines)):
                await alice.ask("POST", f"/batches/{batch}/cancel")
                await alice.ask("DELETE", f"/batches/{batch}")

    # of the queue's thousand places a caller has half: a batch of 1,000 is read whole, then refused
    await alice.all_of(batches(1000 if number % 2 else 100) for number in range(8))


async def batches(alice: Alice) -> None:
    async def unknown(lines: int) -> str | None:
        names = [hashlib.sha256(str(next(_numbers)).encode()).hexdigest() for _ in range(2)]
        request = {"scene": names[0], "object": names[1], "detection": _BOX}
        return await alice.post_batch(request | {"seed": next(_numbers)} for _ in range(lines))

    async def posted_and_gone(_number: int) -> None:
        while True:
            batch = await unknown(200)
            await alice.ask("POST", f"/batches/{batch}/cancel")
            await alice.ask("DELETE", f"/batches/{batch}")

    async def posted() -> None:
        for _ in range(40):
            await unknown(3000)

    await alice.all_of(iter([posted(), *map(posted_and_gone, range(6))]))


async def requests(alice: Alice) -> None:
    names = [hashlib.sha256(str(number).encode()).hexdigest() for number in range(400)]
    body = json.dumps({"scene": alice.told["scene"], "detection": _BOX, "candidates": names}).encode()
    long = body[:-1] + b" " * 900_000 + b"}"

    async def whole() -> None:
        while True:
            await alice.ask("POST", "/register", body)

    async def slow() -> None:
        while True:
            reader, writer = await asyncio.open_connection("127.0.0.1", alice.port)
            head = alice.head("POST", "/register", "Content-Type: application/json", f"Content-Length: {len(long)}")
            writer.write(head + long[:-100_000])
            for begin in range(len(long) - 100_000, len(long), 8192):
                await asyncio.sleep(1.0)
                if writer.is_closing() or reader.at_eof():
                    break
                writer.write(long[begin : begin + 8192])
            await reader.read(1 << 16)
            writer.close()

    await alice.all_of(slow() if number % 2 else whole() for number in range(2 * alice.connections))


async def webhooks(alice: Alice) -> None:
    """The receivers run here too."""

    async def trickle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(1 << 16)
        alice.answers["messages"] += 1
        with suppress(OSError, asyncio.CancelledError):
            writer.write(b"HTTP/1.1 200 OK\r\n")
            while True:
                writer.write(b"HTTP/1.1 103 Early Hints\r\n\r\n" if alice.answers["messages"] % 2 else b"X")
                await writer.drain()
                await asyncio.sleep(0.01 if alice.answers["messages"] % 2 else 3.0)

    server = await asyncio.start_server(trickle, "127.0.0.1", alice.told["receiver"])
    request = {name: alice.told[name] for name in ("scene", "object", "detection")}

    async def jobs() -> None:
        for _ in range(20):
            url = f"http://127.0.0.1:{alice.told['receiver']}/{next(_numbers)}"
            asked = request | {"seed": next(_numbers), "webhook": {"url": url}}
            answer = await alice.ask("POST", "/register", json.dumps(asked).encode())
            job = json.loads(answer.partition(b"\r\n\r\n")[2])["id"]
            await alice.ask("POST", f"/jobs/{job}/cancel")

    async with server:
        await jobs()
        await server.serve_forever()


async def pieces(alice: Alice) -> None:
    """Of a file that begins as a field and has another digest: it is put together and hashed, and its pieces go."""
    header = json.dumps({"__metadata__": {"of": "pieces"}}).encode()
    data = (len(header).to_bytes(8, "little") + header).ljust(60 << 20, b"\0")

    async def finish() -> None:
        while True:
            name = hashlib.sha256(str(next(_numbers)).encode()).hexdigest()
            for begin in range(0, len(data), 30 << 20):
                piece = data[begin : begin + (30 << 20)]
                span = f"Content-Range: bytes {begin}-{begin + len(piece) - 1}/{len(data)}"
                await alice.ask("PUT", f"/fields/{name}", piece, "application/octet-stream", span)

    await alice.all_of(finish() for _ in range(4))


async def uploads(alice: Alice) -> None:
    async def one(number: int) -> None:
        for again in count():
            header = json.dumps({"__metadata__": {"n": f"{number} {again}"}}).encode()
            data = (len(header).to_bytes(8, "little") + header) + b"\n--b" * (2 << 20)
            part = b'--b\r\nContent-Disposition: form-data; name="file"; filename="f"\r\n\r\n'
            kind, body = "application/octet-stream", data
            if number % 2:
                kind, body = "multipart/form-data; boundary=b", part + data + b"\r\n--b--\r\n"
            await alice.ask("POST", "/fields", body, kind)

    await alice.all_of(one(number) for number in range(min(64, alice.connections)))


ATTACKS: dict[str, Callable[[Alice], Awaitable[None]]] = {
    act.__name__.replace("_", " "): act
    for act in (
        pages, filters, results, unread_meshes, unread_pages, library_batches, batches, requests, webhooks, pieces,
        uploads,
    )
}  # fmt: skip


async def attack(name: str, told: dict[str, Any], connections: int, seconds: float) -> None:
    """Until the time is over; whatever breaks is begun anew."""
    alice = Alice(told["port"], connections, told)
    end = time.monotonic() + seconds
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            while time.monotonic() < end:
                with suppress(OSError, asyncio.IncompleteReadError, json.JSONDecodeError, KeyError):
                    await ATTACKS[name](alice)
                await asyncio.sleep(0.2)
    sys.stdout.write(json.dumps(alice.answers.most_common(5)))


# Bob


@dataclass
class Seen:
    """What Bob has measured, in seconds, and the most memory that the front end held meanwhile, bytes."""

    polls: list[float] = field(default_factory=list)
    batches: list[float] = field(default_factory=list)
    uploads: list[float] = field(default_factory=list)
    ready: list[float] = field(default_factory=list)
    memory: int = 0
    failures: Counter[str] = field(default_factory=Counter)


class Bob:
    """Polls from several connections; posts a batch of three and sends a file, one after the other."""

    def __init__(self, house: House, request: dict[str, Any], folder: Path) -> None:
        self._house, self._request, self._folder = house, request, folder
        self.seen = Seen()

    def measure(self, seconds: float) -> Seen:
        end = time.monotonic() + seconds
        job = self._ask("POST", "/register", json=self._request | {"seed": next(_numbers)}).json()["id"]
        work: list[Callable[[], None]] = [lambda: self._poll(f"/jobs/{job}")] * _POLLERS
        work += [self._batch, self._upload, self._ready, self._look]
        threads = [threading.Thread(target=self._until, args=(end, one)) for one in work]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return self.seen

    def _until(self, end: float, act: Callable[[], None]) -> None:
        while time.monotonic() < end:
            try:
                act()
            except (httpx.HTTPError, KeyError) as error:
                self.seen.failures[type(error).__name__] += 1

    def _ask(self, method: str, path: str, who: str = "bob", **content: Any) -> httpx.Response:
        client = _client_of(self._house.address, who)
        answer = client.request(method, path, **content)
        if answer.status_code >= 400:
            self.seen.failures[f"{answer.status_code} {answer.json().get('reason')}"] += 1
            answer.raise_for_status()
        return answer

    def _poll(self, path: str) -> None:
        begun = time.monotonic()
        self._ask("GET", path)
        self.seen.polls.append(time.monotonic() - begun)
        time.sleep(_POLL_EVERY_S)

    def _batch(self) -> None:
        lines = [json.dumps(self._request | {"seed": next(_numbers)}) for _ in range(3)]
        begun = time.monotonic()
        batch = self._ask("POST", "/batches", content="\n".join(lines), headers=_NDJSON).json()
        while batch["status"] == "running" and time.monotonic() < begun + 60:
            batch = self._ask("GET", f"/batches/{batch['id']}", params={"wait": 5}).json()
        self.seen.batches.append(time.monotonic() - begun)

    def _upload(self) -> None:
        header = json.dumps({"__metadata__": {"of": f"Bob {next(_numbers)}"}}).encode()
        data = (len(header).to_bytes(8, "little") + header).ljust(1_200_000, b"\0")
        begun = time.monotonic()
        sent = self._ask("POST", "/fields", files={"file": ("field", data)}).json()
        self.seen.uploads.append(time.monotonic() - begun)
        self._ask("DELETE", f"/fields/{sent['sha256']}")
        time.sleep(0.5)

    def _ready(self) -> None:
        begun = time.monotonic()
        self._ask("GET", "/readyz", who="carol")
        self.seen.ready.append(time.monotonic() - begun)
        time.sleep(0.2)

    def _look(self) -> None:
        self.seen.memory = max(self.seen.memory, self._house.api_memory())
        time.sleep(0.1)


_clients = threading.local()


def _client_of(address: str, who: str) -> httpx.Client:
    """One of this thread's own."""
    held: dict[tuple[str, str], httpx.Client] = _clients.__dict__.setdefault("held", {})
    if (address, who) not in held:
        headers = {"Authorization": f"Bearer {_TOKENS[who]}"}
        held[address, who] = httpx.Client(base_url=address, headers=headers, timeout=60)
    return held[address, who]


# the service


def furnish(house: House) -> list[str]:
    """Give Alice a thousand fields with meshes, half of them a library: written into the stores, for no import does."""
    blobs = LocalBlobStore(house.folder / "state" / "blobs", existing=True)
    names = [hashlib.sha256(f"furnished {number}".encode()).hexdigest() for number in range(_FIELDS)]
    report = {"bounds": [[-1.0] * 3, [1.0] * 3], "warnings": ["x" * 200], "of": ["y" * 40] * 10}
    with connect(house.redis.url) as client:
        store = RecordStore(client)
        now = store.now()
        for number, name in enumerate(names):
            record = FieldRecord(reference_of("alice", name), "validating", 1000, now - number, now, label="furnished")
            store.create_field(record)
            known = store.update_field(record.sha256, attempt=1, state="ready", report=report, views="made")
            if number < _ENTRIES:
                notes = EntryNotes.checked(f"entry {number}", ["furnished"], None, None, None)
                store.set_entry(known, notes)
            if number < 8:
                for view in (PICTURE_NAME, *MESH_NAMES):
                    blobs.put(view_key(record.sha256, view), bytes(_MESH_BYTES))
    return names


def uploaded(house: House, pair: SmallPair, who: str) -> dict[str, Any]:
    """A request between the small pair's fields, once they are imported."""
    client = _client_of(house.address, who)
    named: dict[str, Any] = {"detection": pair.detection, "options": _SMALL, "pictures": False}
    for role, path in (("scene", pair.scene), ("object", pair.object)):
        data = path.read_bytes()
        named[role] = hashlib.sha256(data).hexdigest()
        client.put(f"/fields/{named[role]}", content=data).raise_for_status()
        for _ in range(20):
            if client.get(f"/fields/{named[role]}", params={"wait": 10}).json()["state"] != "validating":
                break
    return named


@contextmanager
def attacked(name: str | None, told: dict[str, Any], connections: int, seconds: float) -> Iterator[Callable[[], str]]:
    """The attack goes on within the block; gives what says how it was answered. Its first seconds are not timed."""
    if name is None:
        yield lambda: ""
        return
    command = [sys.executable, "-m", __spec__.name if __spec__ else "benchmarks.service_load.hostile"]
    command += ["--attack", name, "--told", json.dumps(told)]
    command += ["--connections", str(connections), "--seconds", str(seconds + 10)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            time.sleep(4.0)
            yield lambda: ", ".join(f"{what}: {often}" for what, often in json.loads(process.communicate()[0] or "[]"))
        finally:
            process.kill()


def measure(folder: Path, name: str | None, seconds: float, connections: int) -> tuple[Seen, str]:
    """Bob beside one attack, on a service of its own."""
    pair = write_small_pair(folder)
    with _free_port() as receiver:
        settings: dict[str, Any] = {
            "api_tokens": json.dumps([f"{who}:{token}" for who, token in _TOKENS.items()]),
            "webhook_hosts": json.dumps([f"http://127.0.0.1:{receiver}"]),
            "webhook_secrets": json.dumps([f"alice:{SECRET}"]),
            "quota_stored_bytes": 300 << 20,
        }
        with running_house(folder, 2, _TOKENS["carol"], threads=1, preload=True, **settings) as house:
            told = uploaded(house, pair, "alice") | {"receiver": receiver, "fields": furnish(house)[:8]}
            told["port"] = house.listener.getsockname()[1]
            bob = Bob(house, uploaded(house, pair, "bob"), folder)
            bob._batch()  # the object's model
            bob.seen = Seen()
            with attacked(name, told, connections, seconds) as answers:
                return bob.measure(seconds), answers()


@contextmanager
def _free_port() -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port: int = free.getsockname()[1]
    yield port


def row(name: str, seen: Seen, answers: str) -> tuple[str, bool]:
    """A line of the table, and whether all bars hold."""
    p50, p99 = np.percentile(np.array(seen.polls or [60.0]) * 1000, [50, 99])
    batch, upload = max(seen.batches, default=60.0), max(seen.uploads, default=60.0)
    memory = seen.memory / 1e6
    held = [p99 <= _POLL_MS, batch <= _BATCH_S, upload <= _UPLOAD_S, memory <= _MEMORY_MB, not seen.failures]
    failures = "; ".join(f"{what}: {often}" for what, often in seen.failures.most_common(3))
    cells = [
        str(len(seen.polls)), f"{p50:.0f}", _marked(f"{p99:.0f}", held[0]), str(len(seen.batches)),
        _marked(f"{batch:.2f}", held[1]), _marked(f"{upload:.2f}", held[2]), f"{max(seen.ready, default=60.0):.2f}",
        _marked(f"{memory:.0f}", held[3]), failures, answers,
    ]  # fmt: skip
    return f"| {name} | {' | '.join(cells)} |", all(held)


def _marked(text: str, holds: bool) -> str:
    return text if holds else f"**{text}**"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--connections", type=int, default=100)
    parser.add_argument("--attacks", nargs="+", choices=ATTACKS, default=list(ATTACKS))
    parser.add_argument("--output", type=Path)
    parser.add_argument("--attack", choices=ATTACKS, help=argparse.SUPPRESS)
    parser.add_argument("--told", type=json.loads, help=argparse.SUPPRESS)
    at = parser.parse_args()
    if at.attack:
        asyncio.run(attack(at.attack, at.told, at.connections, at.seconds))
        return 0
    rows, loads, good = [], [load()], True
    for name in (None, *at.attacks):
        with tempfile.TemporaryDirectory(prefix="regnf-") as folder:
            line, holds = row(name or "nobody attacks", *measure(Path(folder), name, at.seconds, at.connections))
        rows.append(line)
        loads.append(load())
        good = good and holds
        sys.stderr.write(line + "\n")
    lines = [
        f"Bob beside each attack of Alice's: {_POLLERS} connections that poll a job, batches of three small "
        "registrations without pictures, "
        f"uploads of 1.2 MB, for {at.seconds:g} s each; {at.connections} connections of Alice's. Bars: p99 of polls "
        f"{_POLL_MS:g} ms, each batch {_BATCH_S:g} s, each upload {_UPLOAD_S:g} s, memory of the front end "
        f"{_MEMORY_MB:g} MB, no call of Bob's fails.",
        "",
        "| attack | polls | p50 ms | p99 ms | batches | longest s | longest upload s | longest /readyz s | memory MB "
        "| Bob's failures | answers to Alice |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
        *rows,
    ]
    command = f"python -m benchmarks.service_load.hostile --seconds {at.seconds:g} --connections {at.connections}"
    write("One caller attacks, another is served", headed(command, loads, lines), at.output)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
