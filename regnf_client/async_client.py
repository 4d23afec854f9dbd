"""The same client, to be awaited."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

import httpx

from regnf_client.answers import refusal, unreachable
from regnf_client.batches import BatchReader, PairLike, PairResult
from regnf_client.calls import Calls, JobLike, LibraryCalls, id_of, signed
from regnf_client.fields import ADDRESS, WORKER_TIMEOUT_S, Connection, Report
from regnf_client.models import Event, EventReader
from regnf_client.steps import Call, Download, Flow, Patience, Pause, Step

_P = ParamSpec("_P")
_T = TypeVar("_T")
_Calls = TypeVar("_Calls")


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


class _Awaited(Generic[_Calls]):
    """What performs flows of calls."""

    def __init__(self, calls: _Calls, driver: AsyncDriver) -> None:
        self._calls = calls
        self._driver = driver


def awaited(
    method: Callable[Concatenate[_Calls, _P], Flow[_T]],
) -> Callable[Concatenate[_Awaited[_Calls], _P], Coroutine[Any, Any, _T]]:
    """A method of a client: the flow, performed. It has the flow's parameters and docstring."""

    @signed(method)
    async def performed(self: _Awaited[_Calls], /, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        return await self._driver.run(method(self._calls, *args, **kwargs))

    return performed


class AsyncLibrary(_Awaited[LibraryCalls]):
    """Objects by name. An ``Entry`` may be given wherever a field may."""

    add = awaited(LibraryCalls.add)
    entries = awaited(LibraryCalls.entries)
    get = awaited(LibraryCalls.get)
    change = awaited(LibraryCalls.change)
    remove = awaited(LibraryCalls.remove)
    download = awaited(LibraryCalls.download)


class AsyncClient(_Awaited[Calls]):
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
        super().__init__(Calls(self._connection), AsyncDriver(self._http))

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
        return AsyncLibrary(LibraryCalls(self._connection), self._driver)

    upload = awaited(Calls.upload)
    field = awaited(Calls.field)
    fields = awaited(Calls.fields)
    delete_field = awaited(Calls.delete_field)
    register = awaited(Calls.register)
    submit = awaited(Calls.submit)
    search = awaited(Calls.search)
    register_batch = awaited(Calls.register_batch)
    render = awaited(Calls.render)
    job = awaited(Calls.job)
    jobs = awaited(Calls.jobs)
    wait = awaited(Calls.wait)
    cancel = awaited(Calls.cancel)
    result = awaited(Calls.result)
    rendering = awaited(Calls.rendering)
    artifact = awaited(Calls.artifact)
    download = awaited(Calls.download)
    save = awaited(Calls.save)

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
