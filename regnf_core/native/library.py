"""The library of compiled code: where it is, whether it is used, and its functions.

It is made when regnf is installed, where there is a C compiler (scripts/native_library.py); without it torch evaluates
the same. REGNF_NATIVE=0 in the environment turns it off.
"""

from __future__ import annotations

import ctypes
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

LIBRARY = Path(__file__).with_name("libregnf_evaluator.so")
SWITCH = "REGNF_NATIVE"
NOT_BUILT = "was not built"
_PLAIN = "plain"
"""The variant for what all processors of a kind have."""
_LAYOUT = 9
"""Of the structures in field.h."""

Evaluate = Callable[[int, int, int, int, "int | None"], int]
"""Addresses of field and points, their count, addresses of distances and gradients (None: not wanted) -> 0, or 1 when
there is no memory."""
Elementary = Callable[[int, int, int, int], None]
"""Which function, the address of its arguments, their count, the address of its results."""


_ADDRESS, _COUNT = ctypes.c_void_p, ctypes.c_int64
_STEPS: dict[str, tuple[Any, ...]] = {
    "places": (None, _ADDRESS, _ADDRESS, ctypes.c_int, _ADDRESS),
    "fill": (ctypes.c_int, _ADDRESS, _ADDRESS, ctypes.c_int, *(_ADDRESS,) * 3),
    "begin": (_ADDRESS, *(_ADDRESS,) * 4),
    "next_places": (None, _ADDRESS, ctypes.c_int, _ADDRESS),
    "next_fill": (ctypes.c_int, _ADDRESS, ctypes.c_int, _ADDRESS, _ADDRESS),
    "settle": (None, _ADDRESS),
    "step": (None, _ADDRESS),
    "score": (None, _ADDRESS, _ADDRESS, _ADDRESS),
    "end": (None, _ADDRESS),
    "grid": (ctypes.c_int, _ADDRESS, _ADDRESS, _COUNT, _ADDRESS, _ADDRESS),
    "voxels": (ctypes.c_int, _ADDRESS, _ADDRESS, _COUNT, _ADDRESS, _ADDRESS),
    "blocks": (ctypes.c_int, _ADDRESS, _ADDRESS, _COUNT, _ADDRESS, _ADDRESS),
    "mesh": (ctypes.c_int, _ADDRESS, _ADDRESS, _COUNT, _ADDRESS, _ADDRESS),
    "block_slots": (None, _ADDRESS, _ADDRESS, _COUNT, _COUNT, _ADDRESS),
    "mesh_nodes": (_COUNT, _COUNT),
    "grow_mesh": (ctypes.c_int, _ADDRESS),
    "mesh_at": (None, _ADDRESS, _ADDRESS, _COUNT, _ADDRESS, _ADDRESS),
    "mesh_closest": (None, _ADDRESS, _ADDRESS, _COUNT, _ADDRESS, _ADDRESS, _ADDRESS),
    "mesh_winding": (None, _ADDRESS, _ADDRESS, _COUNT, _ADDRESS),
    "nearest": (ctypes.c_int, _ADDRESS, _COUNT, _ADDRESS, _COUNT, _COUNT, _ADDRESS, _ADDRESS),
    "nearest_to_cells": (ctypes.c_int, _ADDRESS, _COUNT, _ADDRESS, _ADDRESS, _COUNT, _ADDRESS, _ADDRESS),
    "kernel_sums": (None, _ADDRESS, _ADDRESS, _COUNT, _ADDRESS, _ADDRESS, _COUNT, _ADDRESS),
    "discs": (None, _ADDRESS, _ADDRESS, _COUNT, _COUNT, ctypes.c_float, _ADDRESS),
    "gaussian_depths": (None, _ADDRESS, _ADDRESS, _COUNT, _COUNT, _COUNT, ctypes.c_float, *(_ADDRESS,) * 3),
}


class Steps(ctypes.Structure):
    """regnf_steps of field.h, member by member."""

    _fields_ = tuple((name, ctypes.CFUNCTYPE(*types)) for name, types in _STEPS.items())


@dataclass(frozen=True)
class Variant:
    """The functions for one set of instructions. Calls do not hold the interpreter's lock."""

    name: str
    evaluate: Evaluate
    elementary: Elementary
    steps: Steps


@dataclass(frozen=True)
class Library:
    """What the library has for this processor, fastest first, or why it is not used."""

    variants: tuple[Variant, ...] = ()
    fault: str | None = None
    sources: str = ""
    """A digest of the files that it was made of."""

    @property
    def fastest(self) -> Variant | None:
        """The first variant, where it is faster than torch."""
        return self.variants[0] if self.variants and self.fault is None else None


def variant() -> Variant | None:
    """What evaluates here; None: torch does."""
    if os.environ.get(SWITCH) == "0":
        return None
    return load().fastest


@cache
def load(path: Path = LIBRARY) -> Library:
    """The library in a file, whatever REGNF_NATIVE says."""
    try:
        if not path.exists():
            return Library(fault=NOT_BUILT)
        return _described(ctypes.CDLL(str(path)))
    except (OSError, AttributeError) as error:  # of another system, or not this library
        return Library(fault=f"does not load: {error}")


def _described(code: ctypes.CDLL) -> Library:
    if code.regnf_layout() != _LAYOUT:
        return Library(fault="was built from other sources than these")
    sources = _text(code.regnf_sources)
    names: list[str] = []
    code.regnf_variant.restype = ctypes.c_char_p
    while (name := code.regnf_variant(len(names))) is not None:
        names.append(name.decode())
    slow = names[0] == _PLAIN and platform.machine() == "x86_64"
    fault = "is slower than torch on this processor, which has no AVX2" if slow else None
    return Library(tuple(_variant(code, number, name) for number, name in enumerate(names)), fault, sources)


def _text(function: ctypes._NamedFuncPointer) -> str:
    function.restype = ctypes.c_char_p
    found: bytes = function()
    return found.decode()


def _variant(code: ctypes.CDLL, number: int, name: str) -> Variant:
    pointer, count = ctypes.c_void_p, ctypes.c_int64
    evaluate = ctypes.CFUNCTYPE(ctypes.c_int, pointer, pointer, count, pointer, pointer)
    elementary = ctypes.CFUNCTYPE(None, ctypes.c_int, pointer, count, pointer)
    code.regnf_evaluator.restype = code.regnf_elementary.restype = pointer
    code.regnf_steps_of.restype = ctypes.POINTER(Steps)
    steps = code.regnf_steps_of(number).contents
    return Variant(name, evaluate(code.regnf_evaluator(number)), elementary(code.regnf_elementary(number)), steps)
