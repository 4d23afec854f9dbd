"""Performs the steps of a flow, one after the other."""

from __future__ import annotations

import time
from typing import Any, TypeVar

import httpx

from regnf_client.steps import Call, Download, Flow, Pause, Step

_T = TypeVar("_T")


class SyncDriver:
    """Over one HTTP client."""

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
        """Go on behind what the file holds already."""
        held = step.target.stat().st_size if step.target.exists() else 0
        headers = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={held}-"} if held else {})
        with self._http.stream("GET", step.path, headers=headers) as answer:
            if answer.is_success:
                with step.target.open("ab" if answer.status_code == httpx.codes.PARTIAL_CONTENT else "wb") as file:
                    for block in answer.iter_bytes():
                        file.write(block)
            else:
                answer.read()
            return answer
