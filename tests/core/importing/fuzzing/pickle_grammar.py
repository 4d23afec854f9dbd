"""Pickles that mostly make sense: written by a grammar of opcodes, or taken apart and put together otherwise."""

from __future__ import annotations

import pickletools
from collections.abc import Callable
from random import Random

from tests.core.importing.archives import integer, storage, tensor, text
from tests.core.importing.fuzzing.byte_mutations import NUMBERS, double, little, rearranged

_NAMES = """
torch._utils._rebuild_tensor_v2 torch._utils._rebuild_tensor torch._utils._rebuild_parameter torch.Size
torch._utils._rebuild_parameter_with_state torch._utils._rebuild_sparse_tensor torch._utils._rebuild_qtensor
torch.storage._load_from_bytes torch.FloatStorage collections.OrderedDict collections.Counter collections.defaultdict
builtins.dict __builtin__.list builtins.set builtins.eval builtins.getattr _codecs.encode numpy.dtype
numpy.core.multiarray.scalar numpy._core.multiarray.scalar numpy.core.multiarray._reconstruct copyreg._reconstructor
os.system posix.system this.s antigravity.webbrowser functools.partial operator.attrgetter pkgutil.resolve_name
tests.core.importing.nowhere.thing
"""
"""Among them modules that nothing has loaded yet: an import of one would show."""
TEXTS: tuple[str, ...] = (
    *("", "storage", "cpu", "cuda:0", "meta", "0", "1", "latin1", "pipeline", "f8", "<f4", "u1", "O8", "x" * 300),
)
TEXTS += ("_model.field.glin0.weight_v", "_model.field.aabb", "../0", "a\0b", "\u202e", "state_dict", "99999")
_RARE = (*(bytes([code]) for code in range(256)), b"\x95" + bytes(8), b"(ios\nsystem\n", b"(cos\nsystem\no")
_RARE += (b"\x82\x01", b"P0\n", b"S'a'\n", b"I01\n", b"\x8e" + b"\xff" * 8, b"\x8b\xff\xff\xff\x7f")


class Grammar:
    """Writes pickles; two with the same random numbers are the same."""

    def __init__(self, random: Random) -> None:
        self.random = random
        self.memo = 0

    def pickle(self, body: bytes) -> bytes:
        """A whole pickle around a value; sometimes framed, sometimes with a false frame, protocol or end."""
        random = self.random
        protocol = random.choice((2, 2, 3, 4, 4, 5, 5, 5, 0, 6)) if random.random() < 0.2 else 4
        if random.random() < 0.2:
            length = len(body) + 1 if random.random() < 0.7 else random.choice((*NUMBERS, len(body)))
            body = b"\x95" + little(length, 8) + body
        return b"\x80" + bytes([protocol]) + body + random.choice((b".",) * 30 + (b"", b"..", b".\x80\x02N."))

    def value(self, depth: int = 4) -> bytes:
        """The opcodes of one value."""
        random = self.random
        kinds: list[Callable[[], bytes]] = [self.scalar, self.scalar, self.recall, self.global_name, self.rare]
        if depth > 0:
            nested = [lambda: self.container(depth - 1), lambda: self.call(depth - 1)]
            kinds += [*nested, *nested, self.tensor, self.storage]
        opcodes = random.choice(kinds)()
        return opcodes + self.remember() if random.random() < 0.15 else opcodes

    def scalar(self) -> bytes:
        random = self.random
        wide = random.choice(NUMBERS)
        raw = random.randbytes(random.choice((0, 1, 8, 9, 31, 33, 200)))
        choices = (
            *(b"N", b"\x88", b"\x89", b")", b"]", b"}", b"\x8f"),
            *(b"K" + little(wide, 1), b"M" + little(wide, 2), b"J" + little(wide, 4)),
            *(integer(wide if wide < 1 << 63 else -wide), b"\x8a" + bytes([len(raw)]) + raw),
            b"G" + double(random.choice((0.0, -1.5, 1e308, float("nan"), float("inf")))),
            *(text(random.choice(TEXTS)), text(random.choice(TEXTS)), b"\x8c" + bytes([len(raw)]) + raw),
            *(b"C" + bytes([len(raw)]) + raw, b"B" + little(len(raw), 4) + raw, b"\x8e" + little(len(raw), 8) + raw),
            b"\x96" + little(len(raw), 8) + raw,
        )
        return random.choice(choices)

    def container(self, depth: int) -> bytes:
        random = self.random
        items = [self.value(depth) for _ in range(random.choice((0, 1, 2, 3, 4)))]
        pairs = b"".join(self.key() + item for item in items)
        match random.randrange(8):
            case 0:
                return b"(" + b"".join(items) + random.choice((b"t", b"l", b"\x91"))
            case 1:
                return b"".join(items) + {1: b"\x85", 2: b"\x86", 3: b"\x87"}.get(len(items), b")")
            case 2:
                return b"](" + b"".join(items) + b"e"
            case 3:
                return b"]" + b"".join(item + b"a" for item in items)
            case 4:
                return b"\x8f(" + b"".join(items) + b"\x90"
            case 5:
                return b"(" + pairs + b"d"
            case _:
                return random.choice((b"}", b"ccollections\nOrderedDict\n)R")) + b"(" + pairs + b"u"

    def key(self) -> bytes:
        return self.value(1) if self.random.random() < 0.15 else text(self.random.choice(TEXTS))

    def remember(self) -> bytes:
        self.memo += 1
        choices = (b"\x94", b"q" + little(self.memo, 1), b"r" + little(self.memo, 4))
        return self.random.choice(choices)

    def recall(self) -> bytes:
        index = self.random.randrange(self.memo + 1) if self.random.random() < 0.9 else self.random.choice(NUMBERS)
        return b"h" + little(index, 1) if index < 256 else b"j" + little(index, 4)

    def global_name(self) -> bytes:
        module, _, name = self.random.choice(_NAMES.split()).rpartition(".")
        if self.random.random() < 0.3:
            return text(module) + text(name) + b"\x93"
        return f"c{module}\n{name}\n".encode()

    def call(self, depth: int) -> bytes:
        random = self.random
        args = b"(" + b"".join(self.value(depth) for _ in range(random.choice((0, 1, 1, 2, 4)))) + b"t"
        if random.random() < 0.1:
            return self.global_name() + args + b"}" + b"\x92"
        made = self.global_name() + args + random.choice((b"R", b"R", b"R", b"\x81"))
        return made + self.value(depth) + b"b" if random.random() < 0.2 else made

    def tensor(self) -> bytes:
        """A tensor; each of its claims may be odd."""
        random = self.random
        shape = tuple(self.extent() for _ in range(random.choice((0, 1, 1, 2, 2, 3, 5, 17))))
        strides = tuple(self.extent() for _ in shape)
        if random.random() < 0.6:
            strides = contiguous(shape)
        named = {"kind": random.choice(("FloatStorage", "HalfStorage", "DoubleStorage", "LongStorage", "QInt8Storage"))}
        count = random.choice((None, None, 6, *NUMBERS[:12]))
        odd = random.choice((0, 0, 0, 1, -1, 1 << 40))
        return tensor(random.choice(("0", "1", "77")), shape, strides, odd, count, **named)

    def extent(self) -> int:
        common = (0, 1, 1, 2, 3, 6, 8)
        rare = (-1, 1 << 31, (1 << 47), (1 << 48) - 1, 1 << 48, 1 << 62)
        return self.random.choice(common if self.random.random() < 0.85 else rare)

    def storage(self) -> bytes:
        random = self.random
        return storage(random.choice(("0", "1", "-1", "a", "9" * 30)), random.choice(NUMBERS))

    def rare(self) -> bytes:
        return self.random.choice(_RARE) if self.random.random() < 0.1 else b"N"


def contiguous(shape: tuple[int, ...]) -> tuple[int, ...]:
    """The strides of a dense tensor in row-major order."""
    strides, step = [], 1
    for extent in reversed(shape):
        strides.append(step)
        step *= max(extent, 1)
    return tuple(reversed(strides))


_LENGTHS = dict.fromkeys((b"\x8c", b"C", b"\x8a", b"h", b"q"), 1) | dict.fromkeys((b"\x8d", b"\x8e", b"\x95"), 8)
_LENGTHS |= dict.fromkeys((b"X", b"B", b"\x8b", b"j", b"r", b"J"), 4)
"""Width of the length, index or number that an opcode begins with."""


def opcodes_of(pickle: bytes) -> list[bytes]:
    """A sound pickle's opcodes, one after the other, with their arguments."""
    starts = [position for _, _, position in pickletools.genops(pickle) if position is not None]
    return [pickle[start:end] for start, end in zip(starts, [*starts[1:], len(pickle)], strict=True)]


def respelt(random: Random, opcodes: list[bytes], others: list[bytes]) -> bytes:
    """The pickle after one to four changes to its opcodes, the first of which stays."""
    first, *rest = opcodes
    for _ in range(random.choice((1, 1, 2, 4))):
        rest = rearranged(random, rest or [b"."], others, lambda code: _odd_opcode(random, code))
    return first + b"".join(rest)


def _odd_opcode(random: Random, code: bytes) -> bytes:
    """Another value in its place or before it, another length, or another opcode."""
    if code[:1] in _LENGTHS and random.random() < 0.4:
        width = _LENGTHS[code[:1]]
        return code[:1] + little(random.choice((*NUMBERS, len(code), len(code) - 1)), width) + code[1 + width :]
    value = Grammar(random).value(3)
    return random.choice((value, value + b"0" + code, bytes([random.randrange(256)]) + code[1:]))
