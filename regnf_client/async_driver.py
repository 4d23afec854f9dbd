"""Performs the steps of a flow without blocking the event loop."""

from __future__ import annotations

import asyncio
from typing import Any, TypeVar

import httpx

from regnf_client.steps import Call, Download, Flow, Pause, Step

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
