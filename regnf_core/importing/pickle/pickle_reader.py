"""A reader of torch.save's pickles that never imports and never calls what the file names.

The opcodes that torch's pickles use (protocols 2 to 5) are walked by hand. Tensors become TensorRef, the few globals
of ``pickle_globals`` have a fixed meaning, every other global becomes a Placeholder on which calls, state and items
have no effect. Nothing here or later walks the values recursively, so nesting and shared references cost nothing; the
opcode count, the stack, the marks, the memo, strings and integers are capped all the same.
"""

from __future__ import annotations

import pickle
import struct
from collections.abc import Callable
from typing import Any

from regnf_core.importing.pickle.pickle_machine import (
    PickleLimits,
    PickleMachine,
    PickleStream,
    StorageRef,
    pickle_error,
)


def read_pickle(data: memoryview, limits: PickleLimits | None = None) -> Any:
    """The one value a pickle describes: plain containers and scalars, TensorRef, GlobalRef and Placeholder.

    Raises FieldFormatError with PICKLE_MALFORMED, PICKLE_OPCODE_NOT_ALLOWED, PICKLE_PROTOCOL, PICKLE_TOO_COMPLEX,
    PICKLE_TOO_DEEP, PICKLE_INTEGER_TOO_LARGE, PICKLE_STRING_TOO_LARGE or PICKLE_TRAILING_DATA.
    """
    machine = PickleMachine(data, limits or PickleLimits())
    value = _run(machine)
    if machine.stream.remaining:
        raise pickle_error("bytes after the end of the pickle", "PICKLE_TRAILING_DATA")
    return value


def read_leading_pickle(data: memoryview, limits: PickleLimits) -> tuple[Any, int, dict[str, StorageRef]]:
    """The value of the pickle that ``data`` begins with, the pickle's length, and the storages it names, by their key.

    Raises what :func:`read_pickle` raises, but for what lies behind it.
    """
    machine = PickleMachine(data, limits)
    value = _run(machine)
    return value, machine.stream.position, machine.storages


def _run(machine: PickleMachine) -> Any:
    """Run the program to its STOP. Returns the one value that is left."""
    stream = machine.stream
    if stream.remaining < 2 or stream.unsigned(1) != pickle.PROTO[0]:
        raise pickle_error("the pickle names no protocol", "PICKLE_PROTOCOL")
    if not 2 <= (version := stream.unsigned(1)) <= 5:
        raise pickle_error(f"pickle protocol {version}", "PICKLE_PROTOCOL")
    while True:
        start = stream.position
        opcode = stream.take(1).tobytes()
        if opcode == pickle.STOP:
            return machine.finish()
        action = _ACTIONS.get(opcode)
        if action is None:
            raise pickle_error(f"opcode {opcode!r} is not allowed in checkpoints", "PICKLE_OPCODE_NOT_ALLOWED")
        machine.charge(1)
        action(machine)
        if start < machine.frame_end < stream.position:
            raise pickle_error("an opcode crosses the end of its frame")
        if len(machine.stack) > machine.limits.stack:
            raise pickle_error("values nested too deeply", "PICKLE_TOO_DEEP")


_Action = Callable[[PickleMachine], object]


def _pushing(read: Callable[[PickleStream], Any]) -> _Action:
    """An opcode that reads its value from the stream and pushes it."""
    return lambda machine: machine.push(read(machine.stream))


_ACTIONS: dict[bytes, _Action] = {
    pickle.FRAME: PickleMachine.frame,
    pickle.MARK: PickleMachine.mark,
    pickle.POP: PickleMachine.pop,
    pickle.POP_MARK: PickleMachine.pop_to_mark,
    pickle.DUP: lambda m: m.push(m.top()),
    pickle.NONE: lambda m: m.push(None),
    pickle.NEWTRUE: lambda m: m.push(True),
    pickle.NEWFALSE: lambda m: m.push(False),
    pickle.BININT: _pushing(lambda s: s.integer(4)),
    pickle.BININT1: _pushing(lambda s: s.unsigned(1)),
    pickle.BININT2: _pushing(lambda s: s.unsigned(2)),
    pickle.LONG1: _pushing(lambda s: s.integer(s.unsigned(1))),
    pickle.LONG4: _pushing(lambda s: s.integer(s.unsigned(4))),
    pickle.BINFLOAT: _pushing(lambda s: struct.unpack(">d", s.take(8))[0]),
    pickle.SHORT_BINUNICODE: _pushing(lambda s: s.text(1)),
    pickle.BINUNICODE: _pushing(lambda s: s.text(4)),
    pickle.BINUNICODE8: _pushing(lambda s: s.text(8)),
    pickle.SHORT_BINBYTES: _pushing(lambda s: s.blob(1)),
    pickle.BINBYTES: _pushing(lambda s: s.blob(4)),
    pickle.BINBYTES8: _pushing(lambda s: s.blob(8)),
    pickle.BYTEARRAY8: _pushing(lambda s: s.blob(8)),
    pickle.EMPTY_LIST: lambda m: m.push([]),
    pickle.EMPTY_TUPLE: lambda m: m.push(()),
    pickle.EMPTY_DICT: lambda m: m.push({}),
    pickle.EMPTY_SET: lambda m: m.push([]),
    pickle.TUPLE: lambda m: m.push(tuple(m.pop_to_mark())),
    pickle.TUPLE1: lambda m: m.tuple_of(1),
    pickle.TUPLE2: lambda m: m.tuple_of(2),
    pickle.TUPLE3: lambda m: m.tuple_of(3),
    pickle.LIST: lambda m: m.push(m.pop_to_mark()),
    pickle.FROZENSET: lambda m: m.push(tuple(m.pop_to_mark())),
    pickle.DICT: PickleMachine.new_dict,
    pickle.APPEND: lambda m: m.extend([m.pop()]),
    pickle.APPENDS: lambda m: m.extend(m.pop_to_mark()),
    pickle.ADDITEMS: lambda m: m.extend(m.pop_to_mark()),
    pickle.SETITEM: lambda m: m.set_items([m.pop(), m.pop()][::-1]),
    pickle.SETITEMS: lambda m: m.set_items(m.pop_to_mark()),
    pickle.BINPUT: lambda m: m.put(m.stream.unsigned(1)),
    pickle.LONG_BINPUT: lambda m: m.put(m.stream.unsigned(4)),
    pickle.MEMOIZE: lambda m: m.put(len(m.memo)),
    pickle.BINGET: lambda m: m.get(m.stream.unsigned(1)),
    pickle.LONG_BINGET: lambda m: m.get(m.stream.unsigned(4)),
    pickle.GLOBAL: lambda m: m.name_global(m.stream.line(), m.stream.line()),
    pickle.STACK_GLOBAL: lambda m: m.name_global(*[m.pop(), m.pop()][::-1]),
    pickle.REDUCE: PickleMachine.reduce,
    pickle.NEWOBJ: PickleMachine.reduce,
    pickle.NEWOBJ_EX: PickleMachine.new_object_with_keywords,
    pickle.BUILD: PickleMachine.build,
    pickle.BINPERSID: PickleMachine.persistent,
}
"""Absent, so refused: INST, OBJ, EXT1/2/4, PERSID, the buffers of protocol 5 and the text opcodes of protocol 0."""
