"""The client that blocks until an answer is there, and the same to be awaited."""

from __future__ import annotations

import asyncio
import inspect
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Iterator
from functools import update_wrapper
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

import httpx

from regnf_client.answers import refusal, unreachable
from regnf_client.batches import BatchReader, PairLike, PairResult
from regnf_client.calls import Calls, JobLike, LibraryCalls, id_of
from regnf_client.models import Event, EventReader
from regnf_client.steps import ADDRESS, WORKER_TIMEOUT_S, Call, Connection, Download, Flow, Pause, Report, Step, Tries

_P = ParamSpec("_P")
_T = TypeVar("_T")
_Calls = TypeVar("_Calls")
_Driver = TypeVar("_Driver")
_Function = TypeVar("_Function", bound=Callable[..., Any])


class SyncDriver:
    """Performs the steps of flows over one HTTP client."""

    def __init__(self, http: httpx.Client) -> None:
        self._http = http

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)

    def run(self, flow: Flow[_T]) -> _T:
        """What the flow returns."""
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
    """The same, awaited; what takes time is done in threads."""

    def __init__(self, http: httpx.AsyncClient) -> None:
        self._http = http

    async def run(self, flow: Flow[_T]) -> _T:
        """What the flow returns."""
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


class _Performing(Generic[_Calls, _Driver]):
    """What performs the flows of calls with a driver."""

    def __init__(self, calls: _Calls, driver: _Driver) -> None:
        self._calls = calls
        self._driver = driver


def _signed(function: _Function, flow: Callable[..., Flow[Any]]) -> _Function:
    """The function with the name, the docstring and the signature of a flow, with what the flow returns."""
    signature = inspect.signature(flow)
    returned = str(signature.return_annotation).removeprefix("Flow[").removesuffix("]")
    update_wrapper(function, flow)
    function.__signature__ = signature.replace(return_annotation=returned)  # type: ignore[attr-defined]
    return function


def blocking(
    method: Callable[Concatenate[_Calls, _P], Flow[_T]],
) -> Callable[Concatenate[_Performing[_Calls, SyncDriver], _P], _T]:
    """A method of a client: the flow, performed."""

    def performed(self: _Performing[_Calls, SyncDriver], /, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        return self._driver.run(method(self._calls, *args, **kwargs))

    return _signed(performed, method)


def awaited(
    method: Callable[Concatenate[_Calls, _P], Flow[_T]],
) -> Callable[Concatenate[_Performing[_Calls, AsyncDriver], _P], Coroutine[Any, Any, _T]]:
    """The same, to be awaited."""

    async def performed(self: _Performing[_Calls, AsyncDriver], /, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        return await self._driver.run(method(self._calls, *args, **kwargs))

    return _signed(performed, method)


class Library(_Performing[LibraryCalls, SyncDriver]):
    """Objects by name. An ``Entry`` may be given wherever a field may."""

    add = blocking(LibraryCalls.add)
    entries = blocking(LibraryCalls.entries)
    get = blocking(LibraryCalls.get)
    change = blocking(LibraryCalls.change)
    remove = blocking(LibraryCalls.remove)
    download = blocking(LibraryCalls.download)


class Client(_Performing[Calls, SyncDriver]):
    """A regnf service.

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
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        """token: None takes that of the environment variable REGNF_API_TOKEN, if it is set. worker_timeout_s: how long
        to wait while the service has no worker; None: for ever. transport: of httpx, for proxies and tests."""
        self._connection = Connection(address, token, retries, worker_timeout_s)
        self._http = httpx.Client(transport=transport, **self._connection.http_options())
        super().__init__(Calls(self._connection), SyncDriver(self._http))

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections."""
        self._http.close()

    @property
    def address(self) -> str:
        """Of the service."""
        return self._connection.address.rstrip("/")

    @property
    def library(self) -> Library:
        """Objects by name, with tags."""
        return Library(LibraryCalls(self._connection), self._driver)

    upload = blocking(Calls.upload)
    field = blocking(Calls.field)
    fields = blocking(Calls.fields)
    delete_field = blocking(Calls.delete_field)
    register = blocking(Calls.register)
    submit = blocking(Calls.submit)
    search = blocking(Calls.search)
    register_batch = blocking(Calls.register_batch)
    render = blocking(Calls.render)
    job = blocking(Calls.job)
    jobs = blocking(Calls.jobs)
    wait = blocking(Calls.wait)
    cancel = blocking(Calls.cancel)
    result = blocking(Calls.result)
    rendering = blocking(Calls.rendering)
    artifact = blocking(Calls.artifact)
    download = blocking(Calls.download)
    save = blocking(Calls.save)

    def batch(
        self, requests: Iterable[PairLike], progress: Report | None = None, timeout_s: float | None = None
    ) -> Iterator[PairResult]:
        """Any number of registrations, each a ``Pair`` or the members of a request; results as they come.

        A pair that fails stops no other. Called again with the same requests after an interruption, it goes on.
        """
        asking = self._connection.asking(progress, timeout_s)
        reader = BatchReader(asking, requests, asking.deadline())
        while (found := self._driver.run(reader.post())) is not None:
            while found is not None:
                yield from found
                found = self._driver.run(reader.read())

    def watch(self, job: JobLike) -> Iterator[Event]:
        """A job's events as they come, until it has finished; a broken stream goes on where it stopped."""
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


class AsyncLibrary(_Performing[LibraryCalls, AsyncDriver]):
    """Objects by name. An ``Entry`` may be given wherever a field may."""

    add = awaited(LibraryCalls.add)
    entries = awaited(LibraryCalls.entries)
    get = awaited(LibraryCalls.get)
    change = awaited(LibraryCalls.change)
    remove = awaited(LibraryCalls.remove)
    download = awaited(LibraryCalls.download)


class AsyncClient(_Performing[Calls, AsyncDriver]):
    """The same as ``Client``, to be awaited. Files are read and hashed in threads."""

    def __init__(
        self,
        address: str = ADDRESS,
        token: str | None = None,
        *,
        retries: int = 4,
        worker_timeout_s: float | None = WORKER_TIMEOUT_S,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
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
