"""Builds the native evaluator: the C files of regnf_core/native as one library beside them.

    python scripts/native_library.py      # in a checkout; quick when nothing has changed

The wheel's build hook does the same. Without a C compiler, or with REGNF_NATIVE=0, there is no library, and regnf
evaluates with torch. CC names another compiler. Only the standard library is needed.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

FOLDER = Path("regnf_core/native")
NAME = "libregnf_evaluator.so"
OPTIONS = ("-std=gnu11", "-O3", "-fPIC", "-fvisibility=hidden", "-fno-math-errno", "-fno-trapping-math")
"""None of them lets the compiler change the order of sums, or take NaN for a number."""
PLAIN: dict[str, tuple[str, ...]] = {"plain": ()}
_WIDE = tuple(f"-mavx512{part}" for part in ("f", "dq", "bw", "vl"))
VARIANTS = {
    "x86_64": PLAIN | {"avx2": ("-mavx2", "-mfma"), "avx512": ("-mavx2", "-mfma", *_WIDE, "-mprefer-vector-width=512")}
}
"""Options for each set of instructions, by processor. ``plain`` is what all processors of a kind have."""


class NotBuiltError(Exception):
    """There is no library, and why."""


def sources_digest(folder: Path) -> str:
    """Of the C files, whatever their order."""
    files = sorted([*folder.glob("*.c"), *folder.glob("*.h")])
    return hashlib.sha256(b"\0".join(path.name.encode() + b"\0" + path.read_bytes() for path in files)).hexdigest()


def build(folder: Path, target: Path) -> None:
    """Make ``target`` of the C files in ``folder``, unless it is made of these already. Raises NotBuiltError; a library
    of other files is gone then."""
    digest = sources_digest(folder)
    if target.exists() and digest.encode() in target.read_bytes():
        return
    target.unlink(missing_ok=True)
    if os.environ.get("REGNF_NATIVE") == "0":
        raise NotBuiltError("REGNF_NATIVE is 0")
    if sys.platform != "linux" or sys.maxsize < 2**32:
        raise NotBuiltError("only built for 64-bit Linux")
    compiler = shlex.split(os.environ.get("CC", "")) or [_found_compiler()]
    with tempfile.TemporaryDirectory(dir=target.parent) as scratch:
        made = Path(scratch) / NAME
        _compile(compiler, folder, digest, made)
        os.replace(made, target)  # whole or not at all


def _found_compiler() -> str:
    found = next(filter(None, map(shutil.which, ("gcc", "cc", "clang"))), None)
    if found is None:
        raise NotBuiltError("no C compiler")
    return found


def _compile(compiler: list[str], folder: Path, digest: str, made: Path) -> None:
    objects = []
    for name, options in VARIANTS.get(platform.machine(), PLAIN).items():
        objects.append(made.with_name(f"{name}.o"))
        _run([*compiler, *OPTIONS, *options, f"-DREGNF_SET={name}", "-c", folder / "evaluate.c", "-o", objects[-1]])
    objects.append(made.with_name("library.o"))
    _run([*compiler, *OPTIONS, f'-DREGNF_SOURCES="{digest}"', "-c", folder / "library.c", "-o", objects[-1]])
    _run([*compiler, "-shared", "-o", made, *objects, "-lm"])


def _run(command: list[str | Path]) -> None:
    try:
        done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)
    except OSError as error:
        raise NotBuiltError(f"{command[0]}: {error}") from error
    if done.returncode != 0:
        raise NotBuiltError(f"{command[0]} failed:\n{done.stderr}")


def main() -> None:
    folder = Path(__file__).resolve().parents[1] / FOLDER
    try:
        build(folder, folder / NAME)
    except NotBuiltError as error:
        print(f"No native evaluator ({error}): fields are evaluated with torch, which takes longer.", file=sys.stderr)


if __name__ == "__main__":
    main()
