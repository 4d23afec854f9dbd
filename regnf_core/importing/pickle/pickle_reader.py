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
from dataclasses import dataclass
from typing import Any

from regnf_core.importing.pickle import pickle_globals
from regnf_core.importing.pickle.pickle_globals import dict_key, key_work
from regnf_core.importing.pickle.pickle_stream import PickleStream, pickle_error
from regnf_core.importing.pickle.pickle_values import GlobalRef, NumpyType, Placeholder, StorageRef

_MAX_GLOBAL_NAME = 256


@dataclass(frozen=True)
class PickleLimits:
    """How much one pickle may ask for. Real checkpoints stay below a hundredth of each."""

    opcodes: int = 1_000_000
    stack: int = 100_000
    marks: int = 256
    memo: int = 500_000


def read_pickle(data: memoryview, limits: PickleLimits | None = None) -> Any:
    """The one value a pickle describes: plain containers and scalars, TensorRef, GlobalRef and Placeholder.

    Raises FieldFormatError with PICKLE_MALFORMED, PICKLE_OPCODE_NOT_ALLOWED, PICKLE_PROTOCOL, PICKLE_TOO_COMPLEX,
    PICKLE_TOO_DEEP, PICKLE_INTEGER_TOO_LARGE, PICKLE_STRING_TOO_LARGE or PICKLE_TRAILING_DATA.
    """
    machine = _Machine(data, limits or PickleLimits())
    value = machine.run()
    if machine.stream.remaining:
        raise pickle_error("bytes behind the pickle's end", "PICKLE_TRAILING_DATA")
    return value


@dataclass(frozen=True)
class LeadingPickle:
    """A pickle with something behind it: its value, its length in bytes, and the storages it names, by their key."""

    value: Any
    length: int
    storages: dict[str, StorageRef]


def read_leading_pickle(data: memoryview, limits: PickleLimits | None = None) -> LeadingPickle:
    """The pickle that ``data`` begins with. Raises what :func:`read_pickle` raises, but for what lies behind it."""
    machine = _Machine(data, limits or PickleLimits())
    value = machine.run()
    return LeadingPickle(value, machine.stream.position, machine.storages)


class _Machine:
    """The stack machine. One method an opcode that does more than push a value."""

    def __init__(self, data: memoryview, limits: PickleLimits) -> None:
        self.stream = PickleStream(data)
        self.limits = limits
        self.budget = limits.opcodes
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}
        self.frame_end = 0
        self.storages: dict[str, StorageRef] = {}

    def run(self) -> Any:
        self._read_protocol()
        while True:
            start = self.stream.position
            opcode = self.stream.take(1).tobytes()
            if opcode == pickle.STOP:
                return self._finish()
            action = _ACTIONS.get(opcode)
            if action is None:
                raise pickle_error(f"opcode {opcode!r} does not occur in checkpoints", "PICKLE_OPCODE_NOT_ALLOWED")
            self.charge(1)
            action(self)
            if start < self.frame_end < self.stream.position:
                raise pickle_error("an opcode crosses the end of its frame")
            if len(self.stack) > self.limits.stack:
                raise pickle_error("values nested too deeply", "PICKLE_TOO_DEEP")

    def charge(self, work: int) -> None:
        """Spend ``work`` of the opcode budget."""
        self.budget -= work
        if self.budget < 0:
            raise pickle_error("the pickle asks for too much work", "PICKLE_TOO_COMPLEX")

    def _read_protocol(self) -> None:
        if self.stream.remaining < 2 or self.stream.byte() != pickle.PROTO[0]:
            raise pickle_error("the pickle names no protocol", "PICKLE_PROTOCOL")
        version = self.stream.byte()
        if not 2 <= version <= 5:
            raise pickle_error(f"pickle protocol {version}", "PICKLE_PROTOCOL")

    def _finish(self) -> Any:
        if len(self.stack) != 1 or self.marks:
            raise pickle_error("the pickle ends with values left over")
        return self.stack[0]

    # stack

    def pop(self) -> Any:
        floor = self.marks[-1] if self.marks else 0
        if len(self.stack) <= floor:
            raise pickle_error("the pickle takes a value that is not there")
        return self.stack.pop()

    def top(self) -> Any:
        value = self.pop()
        self.stack.append(value)
        return value

    def mark(self) -> None:
        if len(self.marks) >= self.limits.marks:
            raise pickle_error("values nested too deeply", "PICKLE_TOO_DEEP")
        self.marks.append(len(self.stack))

    def pop_to_mark(self) -> list[Any]:
        if not self.marks:
            raise pickle_error("the pickle goes back to a mark that is not there")
        start = self.marks.pop()
        items = self.stack[start:]
        del self.stack[start:]
        return items

    def push(self, value: Any) -> None:
        self.stack.append(value)

    # memo

    def put(self, index: int) -> None:
        if len(self.memo) >= self.limits.memo:
            raise pickle_error("the pickle remembers too many values", "PICKLE_TOO_COMPLEX")
        self.memo[index] = self.top()

    def get(self, index: int) -> None:
        if index not in self.memo:
            raise pickle_error("the pickle recalls a value it never stored")
        self.push(self.memo[index])

    # containers

    def tuple_of(self, count: int) -> None:
        items = [self.pop() for _ in range(count)]
        self.push(tuple(reversed(items)))

    def extend(self, items: list[Any]) -> None:
        target = self.top()
        if isinstance(target, list):
            target.extend(items)
        elif not isinstance(target, Placeholder):
            raise pickle_error("items for something that is not a list")

    def append(self) -> None:
        item = self.pop()
        self.extend([item])

    def set_items(self, items: list[Any]) -> None:
        target = self.top()
        if len(items) % 2:
            raise pickle_error("a key without a value")
        if isinstance(target, dict):
            for key, value in zip(items[::2], items[1::2], strict=True):
                self.charge(key_work(key))
                target[dict_key(key)] = value
        elif not isinstance(target, Placeholder):
            raise pickle_error("keys for something that is not a dictionary")

    def set_item(self) -> None:
        value, key = self.pop(), self.pop()
        self.set_items([key, value])

    def dict_of(self, items: list[Any]) -> None:
        self.push({})
        self.set_items(items)

    # names and calls

    def name_global(self, module: Any, name: Any) -> None:
        for part in (module, name):
            if not isinstance(part, str) or not 0 < len(part) <= _MAX_GLOBAL_NAME or not part.isprintable():
                raise pickle_error("a global's name is not plain text")
        self.push(GlobalRef(module, name))

    def stack_global(self) -> None:
        name, module = self.pop(), self.pop()
        self.name_global(module, name)

    def reduce(self) -> None:
        args, function = self.pop(), self.pop()
        if isinstance(args, tuple):
            self.charge(pickle_globals.call_work(args))
        self.push(pickle_globals.call(function, args))

    def new_object_with_keywords(self) -> None:
        keywords, args, kind = self.pop(), self.pop(), self.pop()
        known = isinstance(kind, (GlobalRef, Placeholder)) and isinstance(args, tuple) and isinstance(keywords, dict)
        if not known:
            raise pickle_error("an object of something that is not a class")
        self.push(Placeholder(kind.full_name))

    def build(self) -> None:
        """State for the object below: kept beside a placeholder. A state dict's own (its metadata) is of no use."""
        state = self.pop()
        target = self.top()
        if not isinstance(target, (dict, Placeholder, NumpyType)):
            raise pickle_error("state for something that takes none")
        if isinstance(target, Placeholder):
            target.state = state

    def persistent(self) -> None:
        identifier = self.pop()
        if isinstance(identifier, tuple):
            self.charge(len(identifier))
        storage = pickle_globals.storage(identifier)
        if isinstance(storage, StorageRef):
            self.storages.setdefault(storage.key, storage)
        self.push(storage)

    def frame(self) -> None:
        length = self.stream.unsigned(8)
        if self.stream.position <= self.frame_end or length > self.stream.remaining:
            raise pickle_error("a frame's length contradicts the pickle's")
        self.frame_end = self.stream.position + length


_Action = Callable[[_Machine], object]


def _pushing(read: Callable[[PickleStream], Any]) -> _Action:
    """An opcode that reads its value from the stream and pushes it."""
    return lambda machine: machine.push(read(machine.stream))


def _constant(make: Callable[[], Any]) -> _Action:
    """An opcode that pushes a new value."""
    return lambda machine: machine.push(make())


_ACTIONS: dict[bytes, _Action] = {
    pickle.FRAME: _Machine.frame,
    pickle.MARK: _Machine.mark,
    pickle.POP: _Machine.pop,
    pickle.POP_MARK: _Machine.pop_to_mark,
    pickle.DUP: lambda m: m.push(m.top()),
    pickle.NONE: _constant(lambda: None),
    pickle.NEWTRUE: _constant(lambda: True),
    pickle.NEWFALSE: _constant(lambda: False),
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
    pickle.EMPTY_LIST: _constant(list),
    pickle.EMPTY_TUPLE: _constant(tuple),
    pickle.EMPTY_DICT: _constant(dict),
    pickle.EMPTY_SET: _constant(list),
    pickle.TUPLE: lambda m: m.push(tuple(m.pop_to_mark())),
    pickle.TUPLE1: lambda m: m.tuple_of(1),
    pickle.TUPLE2: lambda m: m.tuple_of(2),
    pickle.TUPLE3: lambda m: m.tuple_of(3),
    pickle.LIST: lambda m: m.push(m.pop_to_mark()),
    pickle.FROZENSET: lambda m: m.push(tuple(m.pop_to_mark())),
    pickle.DICT: lambda m: m.dict_of(m.pop_to_mark()),
    pickle.APPEND: _Machine.append,
    pickle.APPENDS: lambda m: m.extend(m.pop_to_mark()),
    pickle.ADDITEMS: lambda m: m.extend(m.pop_to_mark()),
    pickle.SETITEM: _Machine.set_item,
    pickle.SETITEMS: lambda m: m.set_items(m.pop_to_mark()),
    pickle.BINPUT: lambda m: m.put(m.stream.unsigned(1)),
    pickle.LONG_BINPUT: lambda m: m.put(m.stream.unsigned(4)),
    pickle.MEMOIZE: lambda m: m.put(len(m.memo)),
    pickle.BINGET: lambda m: m.get(m.stream.unsigned(1)),
    pickle.LONG_BINGET: lambda m: m.get(m.stream.unsigned(4)),
    pickle.GLOBAL: lambda m: m.name_global(m.stream.line(), m.stream.line()),
    pickle.STACK_GLOBAL: _Machine.stack_global,
    pickle.REDUCE: _Machine.reduce,
    pickle.NEWOBJ: _Machine.reduce,
    pickle.NEWOBJ_EX: _Machine.new_object_with_keywords,
    pickle.BUILD: _Machine.build,
    pickle.BINPERSID: _Machine.persistent,
}
"""Absent, so refused: INST, OBJ, EXT1/2/4, PERSID, the buffers of protocol 5 and the text opcodes of protocol 0."""
