"""The blocking client and the asynchronous client."""

from __future__ import annotations

import asyncio
import inspect
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Iterator
from functools import update_wrapper
from types import MethodType
from typing import Any, Concatenate, Generic, ParamSpec, Self, TypeVar, overload

import httpx

from regnf_client.answers import refusal, unreachable
from regnf_client.batches import BatchReader, PairLike, PairResult
from regnf_client.calls import Calls, JobLike, LibraryCalls, RecordingCalls, id_of
from regnf_client.models import Event, EventReader
from regnf_client.steps import ADDRESS, WORKER_TIMEOUT_S, Call, Connection, Download, Flow, Pause, Report, Step, Tries

_P = ParamSpec("_P")
_T = TypeVar("_T")
_Driver = TypeVar("_Driver")


class SyncDriver:
    """Performs the steps of flows over one HTTP client."""

    def __init__(self, http: httpx.Client) -> None:
        self._http = http

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)

    def run(self, flow: Flow[_T]) -> _T:
        answer: Any = None
        try:
            while True:
                answer = self._perform(flow.send(answer))
        except StopIteration as done:
            value: _T = done.value
            return value
        finally:
            flow.close()

    def _perform(self, step: Step) -> Any:
        if isinstance(step, Pause):
            return self.sleep(step.seconds)
        try:
            if isinstance(step, Call):
                return self._http.request(step.method, step.path, **step.how)
            if isinstance(step, Download):
                return self._download(step)
        except httpx.RequestError as error:
            return error
        return step.do()

    def _download(self, step: Download) -> httpx.Response:
        with self._http.stream("GET", step.path, headers=step.headers()) as answer:
            if answer.is_success:
                with step.target.open(step.mode(answer)) as file:
                    for block in answer.iter_bytes():
                        file.write(block)
            else:
                answer.read()
            return answer


class AsyncDriver:
    """The asynchronous driver. Slow steps run in threads."""

    def __init__(self, http: httpx.AsyncClient) -> None:
        self._http = http

    async def run(self, flow: Flow[_T]) -> _T:
        answer: Any = None
        try:
            while True:
                answer = await self._perform(flow.send(answer))
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
        async with self._http.stream("GET", step.path, headers=step.headers()) as answer:
            if answer.is_success:
                with step.target.open(step.mode(answer)) as file:
                    async for block in answer.aiter_bytes():
                        await asyncio.to_thread(file.write, block)
            else:
                await answer.aread()
            return answer


class _Performing(Generic[_Driver]):
    """What performs the flows of calls with a driver."""

    def __init__(self, calls: Any, driver: _Driver) -> None:
        self._calls = calls
        self._driver = driver


class _Method(Generic[_P, _T]):
    """A flow as a method of both clients, with its parameters and docstring: one returns what it returns, the other
    something to be awaited."""

    def __init__(self, flow: Callable[Concatenate[Any, _P], Flow[_T]]) -> None:
        self._flow = flow
        signature = inspect.signature(flow)
        returned = str(signature.return_annotation).removeprefix("Flow[").removesuffix("]")
        self.__signature__ = signature.replace(return_annotation=returned)
        update_wrapper(self, flow)

    @overload
    def __get__(self, client: None, owner: type) -> Self: ...
    @overload
    def __get__(self, client: _Performing[SyncDriver], owner: type) -> Callable[_P, _T]: ...
    @overload
    def __get__(self, client: _Performing[AsyncDriver], owner: type) -> Callable[_P, Coroutine[Any, Any, _T]]: ...
    def __get__(self, client: _Performing[Any] | None, owner: type) -> Any:
        return self if client is None else MethodType(self, client)

    def __call__(self, client: _Performing[Any], /, *args: _P.args, **kwargs: _P.kwargs) -> Any:
        return client._driver.run(self._flow(client._calls, *args, **kwargs))


class Library(_Performing[_Driver]):
    """Objects by name. An ``Entry`` can be used in place of a field."""

    add = _Method(LibraryCalls.add)
    entries = _Method(LibraryCalls.entries)
    get = _Method(LibraryCalls.get)
    change = _Method(LibraryCalls.change)
    remove = _Method(LibraryCalls.remove)
    download = _Method(LibraryCalls.download)


class Recordings(_Performing[_Driver]):
    """Depth images with their camera. A recording can be used as a scene."""

    upload = _Method(RecordingCalls.upload)
    frame = _Method(RecordingCalls.frame)
    entries = _Method(RecordingCalls.entries)
    picture = _Method(RecordingCalls.picture)
    delete = _Method(RecordingCalls.delete)


class _Client(_Performing[_Driver]):
    """What both clients have."""

    def __init__(self, connection: Connection, driver: _Driver) -> None:
        super().__init__(Calls(connection), driver)
        self._connection = connection

    @property
    def address(self) -> str:
        """Of the service."""
        return self._connection.address.rstrip("/")

    @property
    def library(self) -> Library[_Driver]:
        """Objects by name, with tags."""
        return Library(LibraryCalls(self._connection), self._driver)

    @property
    def recordings(self) -> Recordings[_Driver]:
        """Depth images with their camera."""
        return Recordings(RecordingCalls(self._connection), self._driver)

    upload = _Method(Calls.upload)
    field = _Method(Calls.field)
    fields = _Method(Calls.fields)
    delete_field = _Method(Calls.delete_field)
    register = _Method(Calls.register)
    submit = _Method(Calls.submit)
    search = _Method(Calls.search)
    register_batch = _Method(Calls.register_batch)
    render = _Method(Calls.render)
    job = _Method(Calls.job)
    jobs = _Method(Calls.jobs)
    wait = _Method(Calls.wait)
    cancel = _Method(Calls.cancel)
    result = _Method(Calls.result)
    rendering = _Method(Calls.rendering)
    artifact = _Method(Calls.artifact)
    download = _Method(Calls.download)
    save = _Method(Calls.save)


class Client(_Client[SyncDriver]):
    """A client of a regnf service.

    Scenes and objects are paths (a file, a training run's folder, an archive of one), SHA-256s or ``Field`` objects. A
    file is sent only if the service does not have it. An interrupted upload of a large file continues. Requests are
    repeated after a rate limit or a lost connection. ``progress`` is called with a phase and its progress, 0..1.

    Errors: see :mod:`regnf_client.answers`. Each error has ``reason`` and ``hint``; ServiceError also has ``status``.
    """

    def __init__(
        self,
        address: str = ADDRESS,
        token: str | None = None,
        *,
        retries: int = 4,
        worker_timeout_s: float | None = WORKER_TIMEOUT_S,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        """token: None takes that of the environment variable REGNF_API_TOKEN, if it is set. worker_timeout_s: how long
        to wait while the service has no worker; None: for ever. transport: of httpx, for proxies and tests."""
        connection = Connection(address, token, retries, worker_timeout_s)
        self._http = httpx.Client(transport=transport, **connection.http_options())
        super().__init__(connection, SyncDriver(self._http))

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections."""
        self._http.close()

    def batch(
        self, requests: Iterable[PairLike], progress: Report | None = None, timeout_s: float | None = None
    ) -> Iterator[PairResult]:
        """Run any number of registrations, each a ``Pair`` or the members of a request. Yields the results as they
        become available.

        A pair that fails does not stop the others. After an interruption, call it again with the same requests to
        continue.
        """
        asking = self._connection.asking(progress, timeout_s)
        reader = BatchReader(asking, requests, asking.deadline())
        while (found := self._driver.run(reader.post())) is not None:
            while found is not None:
                yield from found
                found = self._driver.run(reader.read())

    def watch(self, job: JobLike) -> Iterator[Event]:
        """Yield the events of a job until it has finished. After a lost connection the stream continues."""
        reader, tries = EventReader(), Tries(self._connection.retries)
        while not reader.ended:
            try:
                with self._http.stream("GET", f"/jobs/{id_of(job)}/events", headers=reader.headers()) as answer:
                    if answer.status_code == httpx.codes.NO_CONTENT:
                        return
                    if not answer.is_success:
                        answer.read()
                        raise refusal(answer)
                    reader.connected()
                    for line in answer.iter_lines():
                        if (event := reader.take(line)) is not None:
                            yield event
            except httpx.RequestError as error:
                wait_s = tries.wait_s(error)
                if wait_s is None:
                    raise unreachable(error) from error
                self._driver.sleep(wait_s)


class AsyncClient(_Client[AsyncDriver]):
    """``Client`` with asynchronous methods. Files are read and hashed in threads."""

    def __init__(
        self,
        address: str = ADDRESS,
        token: str | None = None,
        *,
        retries: int = 4,
        worker_timeout_s: float | None = WORKER_TIMEOUT_S,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        connection = Connection(address, token, retries, worker_timeout_s)
        self._http = httpx.AsyncClient(transport=transport, **connection.http_options())
        super().__init__(connection, AsyncDriver(self._http))

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close all connections."""
        await self._http.aclose()

    async def batch(
        self, requests: Iterable[PairLike], progress: Report | None = None, timeout_s: float | None = None
    ) -> AsyncIterator[PairResult]:
        """As ``Client.batch``."""
        asking = self._connection.asking(progress, timeout_s)
        reader = BatchReader(asking, requests, asking.deadline())
        while (found := await self._driver.run(reader.post())) is not None:
            while found is not None:
                for one in found:
                    yield one
                found = await self._driver.run(reader.read())

    async def watch(self, job: JobLike) -> AsyncIterator[Event]:
        """As ``Client.watch``."""
        reader, tries = EventReader(), Tries(self._connection.retries)
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
