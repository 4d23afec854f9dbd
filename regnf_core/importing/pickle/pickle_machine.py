"""The stack machine that a pickle is a program for, without anything that imports or calls."""

from __future__ import annotations

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


class PickleMachine:
    """Stack, marks and memo of a pickle, and one method for each opcode that does more than push a value."""

    def __init__(self, data: memoryview, limits: PickleLimits) -> None:
        self.stream = PickleStream(data)
        self.limits = limits
        self.budget = limits.opcodes
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}
        self.frame_end = 0
        self.storages: dict[str, StorageRef] = {}

    def charge(self, work: int) -> None:
        """Spend ``work`` of the opcode budget."""
        self.budget -= work
        if self.budget < 0:
            raise pickle_error(f"the pickle asks for too much work{self._held()}", "PICKLE_TOO_COMPLEX")

    def _held(self) -> str:
        """What object the pickle is about, for whoever does not know why so large a file is refused."""
        named = next((value.full_name for value in self.stack if isinstance(value, Placeholder)), None)
        return (
            "" if named is None else f"; it holds an object of {named[:120]}: save plain tensors, or give a mesh of it"
        )

    def finish(self) -> Any:
        """The one value on the stack."""
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
