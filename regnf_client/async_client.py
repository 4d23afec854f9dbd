"""The same client, to be awaited."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import httpx

import regnf_client.fields as fields
import regnf_client.jobs as artifacts
import regnf_client.jobs as jobs
import regnf_client.library as library
import regnf_client.registrations as registrations
from regnf_client.answers import refusal, unreachable
from regnf_client.batches import BatchReader, PairLike, PairResult
from regnf_client.fields import ADDRESS, WORKER_TIMEOUT_S, Connection, FieldLike, Report, Sendable
from regnf_client.jobs import JobLike, delete_field, id_of, list_fields, list_jobs
from regnf_client.models import BatchOutcome, Entry, Event, EventReader, Field, Job, Rendering, Result
from regnf_client.registrations import Batch, Request
from regnf_client.steps import Call, Download, Flow, Patience, Pause, Step
from regnf_core.detections.parsing import BoxLike
from regnf_core.field_source import Role, SettingsChoice
from regnf_core.library_entries import EntryNotes
from regnf_core.options import OptionsLike

# Performs the steps of a flow without blocking the event loop.

_T = TypeVar("_T")


class AsyncDriver:
    """Over one HTTP client."""

    def __init__(self, http: httpx.AsyncClient) -> None:
        self._http = http

    async def run(self, flow: Flow[_T]) -> _T:
        """What the flow returns."""
        answer: Any = None
        try:
            while True:
                step = flow.send(answer)
                answer = await self._perform(step)
        except StopIteration as done:
            value: _T = done.value
            return value
        finally:
            flow.close()

    async def _perform(self, step: Step) -> Any:
        if isinstance(step, Pause):
            return await asyncio.sleep(step.seconds)
        try:
            if isinstance(step, Call):
                return await self._http.request(step.method, step.path, **step.how)
            if isinstance(step, Download):
                return await self._download(step)
        except httpx.RequestError as error:
            return error
        return await asyncio.to_thread(step.do)

    async def _download(self, step: Download) -> httpx.Response:
        """Go on behind what the file holds already."""
        held = step.target.stat().st_size if step.target.exists() else 0
        headers = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={held}-"} if held else {})
        async with self._http.stream("GET", step.path, headers=headers) as answer:
            if answer.is_success:
                with step.target.open("ab" if answer.status_code == httpx.codes.PARTIAL_CONTENT else "wb") as file:
                    async for block in answer.aiter_bytes():
                        await asyncio.to_thread(file.write, block)
            else:
                await answer.aread()
            return answer


# The library of the awaited client: ``client.library``.


class AsyncLibrary:
    """Objects by name. An ``Entry`` may be given wherever a field may."""

    def __init__(self, connection: Connection, driver: AsyncDriver) -> None:
        self._connection = connection
        self._driver = driver

    async def add(
        self,
        name: str,
        field: FieldLike,
        tags: Sequence[str] = (),
        unit: str | None = None,
        note: str | None = None,
        symmetry: dict[str, Any] | None = None,
        progress: Report | None = None,
    ) -> Entry:
        """Make a field an entry; a file is uploaded. symmetry: order, axis, continuous; None: the detected one.

        Raises ServiceError (LIBRARY_NAME_TAKEN, FIELD_IN_LIBRARY), InvalidInputError (LIBRARY_ENTRY_INVALID).
        """
        notes = EntryNotes.checked(name, tags, unit, note, symmetry)
        return await self._driver.run(library.add(self._connection.asking(progress), field, notes))

    async def entries(self, tag: str | None = None, name: str | None = None) -> list[Entry]:
        """Those with the tag, and with ``name`` in their names; the one added last first."""
        return await self._driver.run(library.entries(self._connection.asking(), tag, name))

    async def get(self, name: str) -> Entry:
        """Raises ServiceError (LIBRARY_ENTRY_NOT_FOUND)."""
        return await self._driver.run(library.get(self._connection.asking(), name))

    async def change(self, name: str, /, **changes: Any) -> Entry:
        """Change name, tags, unit, note or symmetry; None takes one back. Raises ServiceError (LIBRARY_NAME_TAKEN)."""
        return await self._driver.run(library.change(self._connection.asking(), name, changes))

    async def remove(self, name: str) -> None:
        """Take an entry out; its field stays. Raises ServiceError (LIBRARY_ENTRY_NOT_FOUND)."""
        await self._driver.run(library.remove(self._connection.asking(), name))

    async def download(self, name: str, target: str | Path) -> Path:
        """Write an entry's field, in the safe format."""
        return await self._driver.run(library.download(self._connection.asking(), name, Path(target)))


class AsyncClient:
    """A regnf service. Files are read and hashed in threads.

    Scenes and objects are paths (a file, a training run's folder, an archive of one), SHA-256s or ``Field`` objects. A
    file is sent only if the service lacks it; a large one goes on where an earlier try stopped. What is asked too fast,
    and what a broken connection stopped, is asked again. ``progress`` is called with a phase and the share of it done.

    Errors: see :mod:`regnf_client.answers`. Each has ``reason`` and ``hint``; ServiceError has ``status`` too.
    """

    def __init__(
        self,
        address: str = ADDRESS,
        token: str | None = None,
        *,
        retries: int = 4,
        worker_timeout_s: float | None = WORKER_TIMEOUT_S,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        """token: None takes that of the environment variable REGNF_API_TOKEN, if it is set. worker_timeout_s: how long
        to wait while the service has no worker; None: for ever. transport: of httpx, for proxies and tests."""
        self._connection = Connection(address, token, retries, worker_timeout_s)
        self._http = httpx.AsyncClient(transport=transport, **self._connection.http_options())
        self._driver = AsyncDriver(self._http)

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close all connections."""
        await self._http.aclose()

    @property
    def address(self) -> str:
        """Of the service."""
        return self._connection.address.rstrip("/")

    @property
    def library(self) -> AsyncLibrary:
        """Objects by name, with tags."""
        return AsyncLibrary(self._connection, self._driver)

    async def upload(
        self,
        field: Sendable,
        description: Mapping[str, Any] | None = None,
        settings: SettingsChoice = None,
        role: Role | None = None,
        progress: Report | None = None,
        timeout_s: float | None = None,
    ) -> Field:
        """The field at the service, once its import has ended. ``description`` says what no file says, ``settings``
        names the trainer's settings (None: those beside the file, False: none), as in ``regnf.open_field``."""
        source = fields.source_of(field, description, settings, role)
        return await self._driver.run(fields.upload(self._connection.asking(progress, timeout_s), source))

    async def field(self, field: FieldLike) -> Field:
        """A field as it is now. Raises ServiceError (FIELD_NOT_FOUND)."""
        return await self._driver.run(fields.find(self._connection.asking(), field))

    async def fields(self, label: str | None = None) -> list[Field]:
        """All fields, newest first."""
        return await self._driver.run(list_fields(self._connection.asking(), label))

    async def delete_field(self, field: FieldLike) -> None:
        """Forget a field. Raises ServiceError (FIELD_IN_USE)."""
        await self._driver.run(delete_field(self._connection.asking(), field))

    async def register(
        self,
        scene: FieldLike,
        obj: FieldLike,
        detection: BoxLike,
        options: OptionsLike = None,
        seed: int = 0,
        start: Any = None,
        progress: Report | None = None,
        timeout_s: float | None = None,
    ) -> Result:
        """Find where an object stands in a scene. start: a T_object_scene (4, 4) to look at first."""
        request = Request(detection, options, seed, start)
        return await self._driver.run(
            registrations.register(self._connection.asking(progress, timeout_s), scene, obj, request)
        )

    async def submit(
        self,
        scene: FieldLike,
        obj: FieldLike,
        detection: BoxLike,
        options: OptionsLike = None,
        seed: int = 0,
        start: Any = None,
        more: Mapping[str, Any] | None = None,
        progress: Report | None = None,
    ) -> Job:
        """The same without waiting. more: members of the request that have no parameter here, such as ``webhook``."""
        request = Request(detection, options, seed, start, more or {})
        return await self._driver.run(
            registrations.submit_registration(self._connection.asking(progress), scene, obj, request)
        )

    async def search(
        self,
        scene: FieldLike,
        objects: Sequence[FieldLike],
        detection: BoxLike,
        options: OptionsLike = None,
        seed: int = 0,
        progress: Report | None = None,
        timeout_s: float | None = None,
    ) -> Result:
        """Which of the objects it is, and where; the result's ``candidates`` rank them all."""
        request = Request(detection, options, seed)
        asking = self._connection.asking(progress, timeout_s)
        return await self._driver.run(registrations.search(asking, scene, objects, request))

    async def batch(
        self, requests: Iterable[PairLike], progress: Report | None = None, timeout_s: float | None = None
    ) -> AsyncIterator[PairResult]:
        """Any number of registrations, each a ``Pair`` or the members of a request; results as they come.

        A pair that fails stops no other. Called again with the same requests after an interruption, it goes on.
        """
        asking = self._connection.asking(progress, timeout_s)
        reader = BatchReader(asking, requests, asking.deadline())
        while (found := await self._driver.run(reader.post())) is not None:
            while found is not None:
                for one in found:
                    yield one
                found = await self._driver.run(reader.read())

    async def register_batch(
        self,
        scene: FieldLike,
        detections: Sequence[BoxLike],
        objects: Sequence[FieldLike],
        pairs: Sequence[tuple[int, int]] | None = None,
        options: OptionsLike = None,
        seed: int = 0,
        progress: Report | None = None,
        timeout_s: float | None = None,
    ) -> list[BatchOutcome]:
        """Several registrations in one scene; pairs: numbers of detection and object, None: each with each."""
        asking = self._connection.asking(progress, timeout_s)
        wanted = Batch(detections, objects, pairs, options, seed)
        return await self._driver.run(registrations.batch(asking, scene, wanted))

    async def render(
        self,
        scene: FieldLike,
        edits: Sequence[Mapping[str, Any]] = (),
        request: Mapping[str, Any] | None = None,
        progress: Report | None = None,
        timeout_s: float | None = None,
    ) -> Rendering:
        """Pictures, a mesh and a field of a scene with its edits. request: members of ``POST /render``."""
        asking = self._connection.asking(progress, timeout_s)
        return await self._driver.run(registrations.render(asking, scene, edits, request or {}))

    async def job(self, job: JobLike) -> Job:
        """A job as it is now. Raises ServiceError (JOB_NOT_FOUND, JOB_EXPIRED)."""
        return await self._driver.run(jobs.find(self._connection.asking(), job))

    async def jobs(self, status: str | None = None) -> list[Job]:
        """All jobs, newest first."""
        return await self._driver.run(list_jobs(self._connection.asking(), status))

    async def wait(self, job: JobLike, progress: Report | None = None, timeout_s: float | None = None) -> Job:
        """The job once it has finished. Raises WaitTimeoutError, NoWorkerError."""
        return await self._driver.run(jobs.wait(self._connection.asking(progress, timeout_s), job))

    async def watch(self, job: JobLike) -> AsyncIterator[Event]:
        """A job's events as they come, until it has finished; a broken stream goes on where it stopped."""
        reader, tries = EventReader(), Patience(retries=self._connection.retries).tries()
        while not reader.ended:
            try:
                async with self._http.stream("GET", f"/jobs/{id_of(job)}/events", headers=reader.headers()) as answer:
                    if answer.status_code == httpx.codes.NO_CONTENT:
                        return
                    if not answer.is_success:
                        await answer.aread()
                        raise refusal(answer)
                    reader.connected()
                    async for line in answer.aiter_lines():
                        if (event := reader.take(line)) is not None:
                            yield event
            except httpx.RequestError as error:
                wait_s = tries.wait_s(error)
                if wait_s is None:
                    raise unreachable(error) from error
                await asyncio.sleep(wait_s)

    async def cancel(self, job: JobLike) -> Job:
        """Stop a job; no error if it was stopped before. Raises ServiceError (JOB_FINISHED)."""
        return await self._driver.run(jobs.cancel(self._connection.asking(), job))

    async def result(self, job: JobLike) -> Result:
        """What a registration found. Raises ServiceError: JOB_NOT_READY, or the job's own reason where it failed."""
        return await self._driver.run(jobs.result(self._connection.asking(), job))

    async def rendering(self, job: JobLike) -> Rendering:
        """What a rendering made. Raises ServiceError as ``result`` does."""
        return await self._driver.run(jobs.rendering(self._connection.asking(), job))

    async def artifact(self, job: JobLike, name: str) -> bytes:
        """The bytes of one file of a result. Raises ServiceError (ARTIFACT_NOT_FOUND)."""
        return await self._driver.run(artifacts.artifact(self._connection.asking(), job, name))

    async def download(self, job: JobLike, name: str, target: str | Path) -> Path:
        """Write one file of a result."""
        return await self._driver.run(artifacts.download(self._connection.asking(), job, name, Path(target)))

    async def save(self, found: Result | Rendering, folder: str | Path, progress: Report | None = None) -> list[Path]:
        """Write all files of a result into a folder."""
        return await self._driver.run(artifacts.save(self._connection.asking(progress), found, Path(folder)))
