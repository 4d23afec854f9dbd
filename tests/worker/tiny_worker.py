"""A real worker process whose jobs run the tiny engine: `python -m tests.worker.tiny_worker`, set up by REGNF_*.

TINY_BREAKS names a function, "module:name", that raises TINY_RAISES while the file `break` is in the state folder.
"""

from __future__ import annotations

import builtins
import errno
import importlib
import os
from collections.abc import Mapping
from functools import reduce
from pathlib import Path
from typing import Any

from regnf_state.logs import configure_logging
from regnf_state.queue import Kind
from regnf_state.settings import Settings
from regnf_worker import process
from regnf_worker.kernel import Scratch
from regnf_worker.models import Context
from tests.worker import tiny_engine

FUNCTIONS: Mapping[Kind, process.Function] = {
    "import": tiny_engine.run_import,
    "registration": tiny_engine.run_registration,
}
"""What these workers run instead of regnf_worker.jobs."""


def break_what_is_named() -> None:
    """Replace the named function by one that fails as it is told."""
    module, _, names = os.environ["TINY_BREAKS"].partition(":")
    *owners, name = names.split(".")
    owner: Any = reduce(getattr, owners, importlib.import_module(module))
    whole, gate = getattr(owner, name), Settings().state_dir / "break"

    def broken(*given: Any, **more: Any) -> Any:
        is_meant = not isinstance(given[0] if given else None, Path) or given[0].name.startswith("job-")
        if is_meant and gate.exists():
            raise getattr(builtins, os.environ["TINY_RAISES"])(errno.ENOSPC, "broken")
        return whole(*given, **more)

    setattr(owner, name, staticmethod(broken) if isinstance(vars(owner)[name], staticmethod) else broken)


if __name__ == "__main__":
    configure_logging("text")
    if "TINY_BREAKS" in os.environ:
        break_what_is_named()
    process._LATE_GRACE_S = 1.0
    context = Context.from_settings(Settings())
    scratch = Scratch(context.settings.scratch_dir)
    try:
        process.RegnfWorker(context, scratch, functions=FUNCTIONS, draw=tiny_engine.run_drawing).serve()
    finally:
        scratch.remove()
