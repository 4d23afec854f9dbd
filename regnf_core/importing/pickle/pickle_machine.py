"""The stack machine that a pickle is a program for, without anything that imports or calls."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from regnf_core.errors import FieldFormatError

# A bounded cursor over pickle bytes: every read checks what is left, and how much one value may take.

MAX_STRING_BYTES = 8 * 1024 * 1024
MAX_INTEGER_BYTES = 32
_MAX_LINE_BYTES = 512


def pickle_error(message: str, reason: str = "PICKLE_MALFORMED") -> FieldFormatError:
    return FieldFormatError(message, reason=reason)


class PickleStream:
    """Reads little-endian numbers, strings and lines. ``position`` counts bytes from the pickle's start."""

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self.position = 0

    @property
    def remaining(self) -> int:
        return len(self._data) - self.position

    def take(self, count: int) -> memoryview:
        """The next ``count`` bytes."""
        if count > self.remaining:
            raise pickle_error("the pickle ends in the middle of a value")
        start = self.position
        self.position += count
        return self._data[start : self.position]

    def unsigned(self, size: int) -> int:
        """An unsigned integer of ``size`` bytes."""
        return int.from_bytes(self.take(size), "little")

    def integer(self, size: int) -> int:
        """A two's complement integer of ``size`` bytes; 0 bytes are 0."""
        if size > MAX_INTEGER_BYTES:
            raise pickle_error(f"an integer of {size} bytes", "PICKLE_INTEGER_TOO_LARGE")
        return int.from_bytes(self.take(size), "little", signed=True)

    def blob(self, length_size: int) -> bytes:
        length = self.unsigned(length_size)
        if length > MAX_STRING_BYTES:
            raise pickle_error(f"a string of {length} bytes", "PICKLE_STRING_TOO_LARGE")
        return bytes(self.take(length))

    def text(self, length_size: int) -> str:
        """UTF-8 text behind a length of ``length_size`` bytes; lone surrogates are kept, as Python writes them."""
        try:
            return self.blob(length_size).decode("utf-8", "surrogatepass")
        except UnicodeDecodeError as error:
            raise pickle_error("a string is not UTF-8") from error

    def line(self) -> str:
        """A printable ASCII line up to, without, its newline."""
        window = bytes(self._data[self.position : self.position + _MAX_LINE_BYTES])
        end = window.find(b"\n")
        if end < 0 or not all(0x20 < char < 0x7F for char in window[:end]):
            raise pickle_error("a global's name is not a line of plain text")
        self.position += end + 1
        return window[:end].decode("ascii")


# What the pickle reader makes of a file: plain values, descriptions of tensors, and inert stand-ins for all else.

DTYPES = {
    "FloatStorage": "float32",
    "DoubleStorage": "float64",
    "HalfStorage": "float16",
    "BFloat16Storage": "bfloat16",
}
DTYPES |= {"LongStorage": "int64", "IntStorage": "int32", "ShortStorage": "int16", "CharStorage": "int8"}
DTYPES |= {"ByteStorage": "uint8", "BoolStorage": "bool"}
"""torch's storage classes and the element type of each. Others (complex, quantized) are read but never materialized."""


@dataclass(frozen=True, eq=False, slots=True)
class GlobalRef:
    """A name that occurs in the pickle. Nothing is imported; the name alone decides what the reader does with it."""

    module: str
    name: str

    @property
    def full_name(self) -> str:
        return f"{self.module}.{self.name}"


@dataclass(eq=False, slots=True)
class Placeholder:
    """Stands for an object the reader does not make. ``full_name`` is the global that would have made it."""

    full_name: str
    state: Any = None
    """What the object would have been given as its state, usually its attributes by name. Nothing was done with it."""


@dataclass(frozen=True, eq=False, slots=True)
class StorageRef:
    """A storage in the archive: entry ``data/<key>``. dtype is None for element types that are never materialized."""

    key: str
    dtype: str | None
    type_name: str
    count: int
    device: str


@dataclass(frozen=True, eq=False, slots=True)
class TensorRef:
    """A tensor that has not been read: a view of a storage. offset and strides count elements.

    ``plain`` is false where the tensor is more than a view (e.g. a conjugate or negative bit).
    """

    storage: StorageRef
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    plain: bool


@dataclass(frozen=True, eq=False, slots=True)
class NumpyType:
    """A numpy dtype by its code, e.g. "f8". Scalars of the plain number types are decoded, nothing else."""

    code: str


# What calling a global means to the reader: tensor rebuilders, plain containers, numpy scalars. All else is inert.
#
# This table is the whole allow-list. A name that is not in it is never resolved, imported or called.

Handler = Callable[[GlobalRef, tuple[Any, ...]], Any]

_MAX_DIMENSIONS = 16
_MAX_EXTENT = 1 << 48
_MAX_SCALAR_TEXT = 64
_TUPLE_KEY_WORK = 100
_STORAGE_KEY = re.compile(r"[0-9]{1,20}")
_NUMPY_SCALARS = {"f8": "<d", "f4": "<f", "f2": "<e", "i8": "<q", "i4": "<i", "i2": "<h", "i1": "<b"}
_NUMPY_SCALARS |= {"u8": "<Q", "u4": "<I", "u2": "<H", "u1": "<B", "b1": "<?"}


def call(function: object, args: object) -> Any:
    """What ``function(*args)`` stands for. Raises FieldFormatError (PICKLE_MALFORMED) where that makes no sense."""
    if not isinstance(args, tuple):
        raise pickle_error("arguments that are not a tuple")
    if isinstance(function, Placeholder):
        return Placeholder(function.full_name)
    if not isinstance(function, GlobalRef):
        raise pickle_error("a call of something that is not a global")
    handler = HANDLERS.get((function.module, function.name))
    return handler(function, args) if handler else Placeholder(function.full_name)


def storage_of(identifier: object) -> StorageRef | Placeholder:
    """The storage a persistent id names: ("storage", storage class, key, device, element count).

    Legacy files add a view of another storage, which torch has written as None since its first releases.
    """
    match identifier:
        case ("storage", GlobalRef() as kind, str() as key, str() as device, int() as count, *view) if not any(view):
            if kind.module not in ("torch", "torch.storage"):
                return Placeholder(kind.full_name)
            if not _STORAGE_KEY.fullmatch(key) or not 0 <= count < _MAX_EXTENT or len(device) > _MAX_SCALAR_TEXT:
                raise pickle_error("a storage's key, device or size is malformed")
            return StorageRef(key, DTYPES.get(kind.name), kind.full_name, count, device)
        case ("storage", Placeholder() as kind, *_):
            return Placeholder(kind.full_name)
    raise pickle_error("a persistent id that is not a storage")


def _tensor(_function: GlobalRef, args: tuple[Any, ...]) -> TensorRef | Placeholder:
    """_rebuild_tensor(_v2): (storage, offset, shape, strides[, requires_grad, hooks[, metadata]])."""
    for value in args[:4]:
        if isinstance(value, (Placeholder, GlobalRef)):
            return Placeholder(value.full_name)
    match args:
        case (StorageRef() as source, int() as offset, tuple() as shape, tuple() as strides, *rest):
            if _are_extents((offset,)) and _are_extents(shape) and _are_extents(strides) and len(shape) == len(strides):
                return TensorRef(source, offset, shape, strides, plain=not any(rest[2:]))
    raise pickle_error("a tensor's storage, shape or strides make no sense")


def _are_extents(values: tuple[Any, ...]) -> bool:
    return len(values) <= _MAX_DIMENSIONS and all(type(v) is int and 0 <= v < _MAX_EXTENT for v in values)


def _parameter(_function: GlobalRef, args: tuple[Any, ...]) -> Any:
    """_rebuild_parameter(_with_state): (tensor, requires_grad, hooks[, state])."""
    if args and isinstance(args[0], (TensorRef, Placeholder)):
        return args[0]
    raise pickle_error("a parameter without a tensor")


def _mapping(function: GlobalRef, args: tuple[Any, ...]) -> Any:
    """An empty or copied dict, or one made of [key, value] pairs."""
    if not args:
        return {}
    source = args[0] if len(args) == 1 else None
    if isinstance(source, dict):
        return source
    if isinstance(source, list) and all(isinstance(pair, (list, tuple)) and len(pair) == 2 for pair in source):
        return {dict_key(key): value for key, value in source}
    return Placeholder(function.full_name)


def _sequence(function: GlobalRef, args: tuple[Any, ...]) -> Any:
    """A list, tuple or set of the given items; kept in the container they came in, which is enough here."""
    if not args:
        return []
    if len(args) == 1 and isinstance(args[0], (list, tuple)):
        return args[0]
    return Placeholder(function.full_name)


def _encode(function: GlobalRef, args: tuple[Any, ...]) -> Any:
    """_codecs.encode(text, "latin1"): how protocol 2 spells the few bytes of a scalar."""
    match args:
        case (str() as text, "latin1" | "latin-1") if (
            len(text) <= _MAX_SCALAR_TEXT and max(text, default="") < "\u0100"
        ):
            return text.encode("latin-1")
    return Placeholder(function.full_name)


def _numpy_type(function: GlobalRef, args: tuple[Any, ...]) -> Any:
    if args and isinstance(args[0], str) and len(args[0]) <= 8:
        return NumpyType(args[0].lstrip("<|="))
    return Placeholder(function.full_name)


def _numpy_scalar(function: GlobalRef, args: tuple[Any, ...]) -> Any:
    match args:
        case (NumpyType() as kind, bytes() as raw) if kind.code in _NUMPY_SCALARS:
            layout = _NUMPY_SCALARS[kind.code]
            if len(raw) == struct.calcsize(layout):
                return struct.unpack(layout, raw)[0]
    return Placeholder(function.full_name)


def _reconstructed(function: GlobalRef, args: tuple[Any, ...]) -> Placeholder:
    """copyreg's helper: the class it would instantiate is the name worth telling."""
    named = args[0] if args and isinstance(args[0], (GlobalRef, Placeholder)) else function
    return Placeholder(named.full_name)


def dict_key(value: Any, depth: int = 2) -> Any:
    """``value`` if it may be a dictionary's key: a short scalar, an inert object, or a shallow tuple of such."""
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 64:
        raise pickle_error("a dictionary's key is a very large integer", "PICKLE_INTEGER_TOO_LARGE")
    if value is None or isinstance(value, (str, int, float, bytes, GlobalRef, Placeholder, NumpyType)):
        return value
    if isinstance(value, tuple) and depth > 0 and len(value) <= _MAX_DIMENSIONS:
        return tuple(dict_key(part, depth - 1) for part in value)
    raise pickle_error("a dictionary's key is not a plain value")


def key_work(key: object) -> int:
    """What a dictionary's key costs of the opcode budget.

    Tuples cost more: their hash follows from their numbers alone, so a file can hold any number of them with one hash,
    and each insertion then compares with all before it.
    """
    return _TUPLE_KEY_WORK if isinstance(key, tuple) else 1


def call_work(args: tuple[Any, ...]) -> int:
    """What a call may cost of the opcode budget: it may look at every argument, and make a dictionary of the lists."""
    pairs = (item for arg in args[:2] if isinstance(arg, list) for item in arg)
    return len(args) + sum(key_work(pair[0]) if isinstance(pair, (list, tuple)) and pair else 1 for pair in pairs)


_BUILTINS = ("builtins", "__builtin__")
HANDLERS: dict[tuple[str, str], Handler] = {
    ("torch._utils", "_rebuild_tensor"): _tensor,
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_parameter"): _parameter,
    ("torch._utils", "_rebuild_parameter_with_state"): _parameter,
    ("torch", "Size"): _sequence,
    ("collections", "OrderedDict"): _mapping,
    ("collections", "Counter"): _mapping,
    ("collections", "defaultdict"): lambda function, args: _mapping(function, args[1:]),
    **{(module, "dict"): _mapping for module in _BUILTINS},
    **{(module, name): _sequence for module in _BUILTINS for name in ("list", "tuple", "set", "frozenset")},
    ("_codecs", "encode"): _encode,
    ("numpy", "dtype"): _numpy_type,
    ("numpy.core.multiarray", "scalar"): _numpy_scalar,
    ("numpy._core.multiarray", "scalar"): _numpy_scalar,
    **{(module, "_reconstructor"): _reconstructed for module in ("copyreg", "copy_reg")},
}


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
            # Whoever does not know why so large a file is refused is told what object it is about.
            named = next((value.full_name for value in self.stack if isinstance(value, Placeholder)), None)
            held = (
                f"; it contains an object of {named[:120]}: save plain tensors, or give a mesh of it" if named else ""
            )
            raise pickle_error(f"the pickle needs too much work{held}", "PICKLE_TOO_COMPLEX")

    def finish(self) -> Any:
        """The one value on the stack."""
        if len(self.stack) != 1 or self.marks:
            raise pickle_error("the pickle ends with values left over")
        return self.stack[0]

    # stack

    def pop(self) -> Any:
        floor = self.marks[-1] if self.marks else 0
        if len(self.stack) <= floor:
            raise pickle_error("the pickle uses a value that does not exist")
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
            raise pickle_error("the pickle refers to a mark that does not exist")
        start = self.marks.pop()
        items = self.stack[start:]
        del self.stack[start:]
        return items

    def push(self, value: Any) -> None:
        self.stack.append(value)

    # memo

    def put(self, index: int) -> None:
        if len(self.memo) >= self.limits.memo:
            raise pickle_error("the pickle stores too many values", "PICKLE_TOO_COMPLEX")
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
            raise pickle_error("items are added to something that is not a list")

    def set_items(self, items: list[Any]) -> None:
        target = self.top()
        if len(items) % 2:
            raise pickle_error("a key without a value")
        if isinstance(target, dict):
            for key, value in zip(items[::2], items[1::2], strict=True):
                self.charge(key_work(key))
                target[dict_key(key)] = value
        elif not isinstance(target, Placeholder):
            raise pickle_error("keys are added to something that is not a dictionary")

    def new_dict(self) -> None:
        items = self.pop_to_mark()
        self.push({})
        self.set_items(items)

    # names and calls

    def name_global(self, module: Any, name: Any) -> None:
        for part in (module, name):
            if not isinstance(part, str) or not 0 < len(part) <= _MAX_GLOBAL_NAME or not part.isprintable():
                raise pickle_error("a global's name is not plain text")
        self.push(GlobalRef(module, name))

    def reduce(self) -> None:
        args, function = self.pop(), self.pop()
        if isinstance(args, tuple):
            self.charge(call_work(args))
        self.push(call(function, args))

    def new_object_with_keywords(self) -> None:
        keywords, args, kind = self.pop(), self.pop(), self.pop()
        if not (isinstance(kind, GlobalRef | Placeholder) and isinstance(args, tuple) and isinstance(keywords, dict)):
            raise pickle_error("an object of something that is not a class")
        self.push(Placeholder(kind.full_name))

    def build(self) -> None:
        """State for the object below: kept beside a placeholder. A state dict's own (its metadata) is of no use."""
        state = self.pop()
        target = self.top()
        if not isinstance(target, (dict, Placeholder, NumpyType)):
            raise pickle_error("state is given to something that cannot have one")
        if isinstance(target, Placeholder):
            target.state = state

    def persistent(self) -> None:
        identifier = self.pop()
        if isinstance(identifier, tuple):
            self.charge(len(identifier))
        storage = storage_of(identifier)
        if isinstance(storage, StorageRef):
            self.storages.setdefault(storage.key, storage)
        self.push(storage)

    def frame(self) -> None:
        length = self.stream.unsigned(8)
        if self.stream.position <= self.frame_end or length > self.stream.remaining:
            raise pickle_error("a frame's length contradicts the pickle's")
        self.frame_end = self.stream.position + length
