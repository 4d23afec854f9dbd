"""What calling a global means to the reader: tensor rebuilders, plain containers, numpy scalars. All else is inert.

This table is the whole allow-list. A name that is not in it is never resolved, imported or called.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from typing import Any

from regnf_core.importing.pickle.pickle_stream import pickle_error
from regnf_core.importing.pickle.pickle_values import DTYPES, GlobalRef, NumpyType, Placeholder, StorageRef, TensorRef

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


def storage(identifier: object) -> StorageRef | Placeholder:
    """The storage a persistent id names: ("storage", storage class, key, device, element count).

    Legacy files add a view of another storage, which torch has written as None since its first releases.
    """
    match identifier:
        case ("storage", GlobalRef() as kind, str() as key, str() as device, int() as count, *view) if not any(view):
            known = kind.module in ("torch", "torch.storage")
            if not known:
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


def _default_mapping(function: GlobalRef, args: tuple[Any, ...]) -> Any:
    return _mapping(function, args[1:])


def _sequence(function: GlobalRef, args: tuple[Any, ...]) -> Any:
    """A list, tuple or set of the given items; kept in the container they came in, which is enough here."""
    if not args:
        return []
    if len(args) == 1 and isinstance(args[0], (list, tuple)):
        return args[0]
    return Placeholder(function.full_name)


def _is_latin(text: str) -> bool:
    return all(char < "\u0100" for char in text)


def _encode(function: GlobalRef, args: tuple[Any, ...]) -> Any:
    """_codecs.encode(text, "latin1"): how protocol 2 spells the few bytes of a scalar."""
    match args:
        case (str() as text, "latin1" | "latin-1") if len(text) <= _MAX_SCALAR_TEXT and _is_latin(text):
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
        raise pickle_error("a dictionary's key is a giant integer", "PICKLE_INTEGER_TOO_LARGE")
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
    ("collections", "defaultdict"): _default_mapping,
    **{(module, "dict"): _mapping for module in _BUILTINS},
    **{(module, name): _sequence for module in _BUILTINS for name in ("list", "tuple", "set", "frozenset")},
    ("_codecs", "encode"): _encode,
    ("numpy", "dtype"): _numpy_type,
    ("numpy.core.multiarray", "scalar"): _numpy_scalar,
    ("numpy._core.multiarray", "scalar"): _numpy_scalar,
    **{(module, "_reconstructor"): _reconstructed for module in ("copyreg", "copy_reg")},
}
