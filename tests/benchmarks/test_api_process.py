"""The process that answers at an address is the API's, not the supervisor that holds the same socket."""

from __future__ import annotations

import os
from pathlib import Path

import psutil
import pytest

from benchmarks.api_process import api_process
from regnf_cli.demo import running_service
from tests.processes import descendants_of


def test_the_process_of_the_api(tmp_path: Path) -> None:
    with running_service(tmp_path / "state") as address:
        found = api_process(address)
        assert found in descendants_of(os.getpid())
        assert "regnf_cli.api_process" in psutil.Process(found).cmdline()
        supervisor = psutil.Process(found).ppid()
        assert "serve" in psutil.Process(supervisor).cmdline()
    with pytest.raises(RuntimeError, match="no API process listens"):
        api_process(address)
