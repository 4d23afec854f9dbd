"""Archives of runs, and settings in them, that no trainer left so; each with what becomes of it."""

from __future__ import annotations

import bz2
import gzip
import io
import json
import lzma
import stat
import tarfile
import zipfile
from collections.abc import Callable

from tests.core.importing.archives import patched, zip_bytes
from tests.core.importing.fuzzing.archive_model import Record, archive_bytes
from tests.core.importing.fuzzing.seeds import Seeds
from tests.gate.bad_containers import Files

CHECKPOINT = "run/sdfstudio_models/step-000030000.ckpt"
Members = list[tuple[str, bytes]]
BOMB = "\n".join(
    [
        "a0: &a0 [x, x, x, x, x, x, x, x, x, x]",
        *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 9)),
    ]
)


def tar_bytes(members: Members, **kinds: dict[str, object]) -> bytes:
    """A tar file; ``kinds`` are members of other kinds, by name, with what is special about their headers."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.GNU_FORMAT) as archive:
        for name, data in members:
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
        for name, values in kinds.items():
            member = tarfile.TarInfo(name)
            for key, value in values.items():
                setattr(member, key, value)
            archive.addfile(member)
    return buffer.getvalue()


def with_settings(content: str | bytes | Callable[[], str], name: str = "run/config.yml") -> Callable[[Seeds], bytes]:
    """A zip of a run with this file of settings in it. What is long is a function: every test process collects it."""

    def made(s: Seeds) -> bytes:
        text = content() if callable(content) else content
        data = text.encode() if isinstance(text, str) else text
        return zip_bytes([(CHECKPOINT, s.archive), (name, data)], zipfile.ZIP_DEFLATED)

    return made


def in_tar(**kinds: dict[str, object]) -> Callable[[Seeds], bytes]:
    """A tar file of a run with other members beside it."""
    return lambda s: tar_bytes([(CHECKPOINT, s.archive)], **kinds)


def named(name: str) -> Callable[[Seeds], bytes]:
    """A tar file of a run with a member of this name."""
    return lambda s: tar_bytes([(CHECKPOINT, s.archive), (name, b"x")])


def in_zip_as(kind: int) -> Callable[[Seeds], bytes]:
    """A run whose settings are a file of this kind."""

    def make(s: Seeds) -> bytes:
        odd = zipfile.ZipInfo("run/config.yml")
        odd.external_attr = (kind | 0o777) << 16
        made = io.BytesIO()
        with zipfile.ZipFile(made, "w") as archive:
            archive.writestr(CHECKPOINT, s.archive)
            archive.writestr(odd, "/etc/passwd")
        return made.getvalue()

    return make


def zip_of(name: str) -> Callable[[Seeds], bytes]:
    """A zip of a run with a member of this name."""
    return lambda s: archive_bytes([Record(CHECKPOINT.encode(), s.archive), Record(name.encode(), b"x")])


def zip_bomb(_: Seeds) -> bytes:
    return zip_bytes([(CHECKPOINT, bytes(300 << 20))], zipfile.ZIP_DEFLATED)


def bomb(pack: Callable[[bytes], bytes]) -> Callable[[Seeds], bytes]:
    return lambda _: pack(tar_bytes([("run/a.bin", bytes(300 << 20))]))


def huge_member(s: Seeds) -> bytes:
    whole = tar_bytes([(CHECKPOINT, s.archive)])
    return resummed(patched(whole, 124, b"\x80" + (1 << 62).to_bytes(11, "big")))


def resummed(whole: bytes) -> bytes:
    """The tar file with the first header's sum set right."""
    total = sum(whole[:148]) + 8 * 32 + sum(whole[156:512])
    return patched(whole, 148, b"%06o\0 " % total)


def overlapping(s: Seeds) -> bytes:
    first = Record(CHECKPOINT.encode(), s.archive)
    return archive_bytes([first, Record(b"run/b.ckpt", b"", central={"offset": 0})])


def lying_deflate(s: Seeds) -> bytes:
    whole = zip_bytes([("run/readme.txt", b"x"), (CHECKPOINT, s.archive)], zipfile.ZIP_DEFLATED)
    at = whole.rindex(b"PK\x01\x02")
    size = len(s.archive) - 7
    local = whole.index(CHECKPOINT.encode()) - 30
    return patched(patched(whole, at + 24, size.to_bytes(4, "little")), local + 22, size.to_bytes(4, "little"))


RUNS: Files = {
    "a run without a checkpoint": (lambda _: zip_bytes([("run/notes.txt", b"x")]), "rejected RUN_WITHOUT_CHECKPOINT"),
    "two runs in one archive": (
        lambda s: zip_bytes(
            [("a/sdfstudio_models/step-1.ckpt", s.archive), ("b/sdfstudio_models/step-1.ckpt", s.archive)]
        ),
        "rejected AMBIGUOUS_RUN",
    ),
    "two checkpoints that are no steps of one training": (
        lambda s: tar_bytes([("run/chair.pth", s.archive), ("run/table.pth", s.archive)]),
        "rejected AMBIGUOUS_RUN",
    ),
    "an archive in an archive": (
        lambda s: zip_bytes([("run/last.ckpt", tar_bytes([(CHECKPOINT, s.archive)]))]),
        "rejected ARCHIVE_NESTED",
    ),
    "a run in a zip, a ../ member": (zip_of("run/../../x"), "rejected ARCHIVE_ENTRY_NAME"),
    "a run in a zip, an absolute member": (zip_of("/etc/x"), "rejected ARCHIVE_ENTRY_NAME"),
    "a run in a zip, a backslash": (zip_of("run\\x"), "rejected ARCHIVE_ENTRY_NAME"),
    "a run in a zip, encrypted": (
        lambda s: archive_bytes([Record(CHECKPOINT.encode(), s.archive, local={"flags": 1}, central={"flags": 1})]),
        "rejected ARCHIVE_ENCRYPTED",
    ),
    "a run in a zip, a name twice": (
        lambda s: archive_bytes([Record(CHECKPOINT.encode(), s.archive)] * 2),
        "rejected ARCHIVE_DUPLICATE_ENTRY",
    ),
    "a run in a zip, members that overlap": (overlapping, "rejected ARCHIVE_OVERLAP"),
    "a run in a zip, a member that inflates to another size": (lying_deflate, "rejected ARCHIVE_DEFLATE_MALFORMED"),
    "a zip bomb": (zip_bomb, "rejected ARCHIVE_TOO_LARGE"),
    "a gzip bomb": (bomb(lambda data: gzip.compress(data, 9)), "rejected ARCHIVE_TOO_LARGE"),
    "a bzip2 bomb": (bomb(bz2.compress), "rejected ARCHIVE_TOO_LARGE"),
    "an xz bomb": (bomb(lzma.compress), "rejected ARCHIVE_TOO_LARGE"),
    "a tar.gz cut short": (
        lambda s: gzip.compress(tar_bytes([(CHECKPOINT, s.archive)]))[:-200],
        "rejected FILE_TRUNCATED",
    ),
    "a tar.gz with something behind it": (
        lambda s: gzip.compress(tar_bytes([(CHECKPOINT, s.archive)])) + b"more",
        "rejected ARCHIVE_TRAILING_DATA",
    ),
    "a gzip file of no tar": (lambda s: gzip.compress(b"notes" * 400), "rejected ARCHIVE_MALFORMED"),
    "a tar cut short": (
        lambda s: tar_bytes([(CHECKPOINT, s.archive)])[: len(s.archive) // 2],
        "rejected FILE_TRUNCATED",
    ),
    "a tar with something behind its end": (
        lambda s: tar_bytes([(CHECKPOINT, s.archive)]) + b"more",
        "rejected ARCHIVE_TRAILING_DATA",
    ),
    "a zip, a symbolic link": (in_zip_as(stat.S_IFLNK), "rejected ARCHIVE_LINK"),
    "a zip, a device": (in_zip_as(stat.S_IFCHR), "rejected ARCHIVE_SPECIAL_FILE"),
    "a zip, a pipe": (in_zip_as(stat.S_IFIFO), "rejected ARCHIVE_SPECIAL_FILE"),
    "a tar, a symbolic link": (
        in_tar(**{"run/config.yml": {"type": tarfile.SYMTYPE, "linkname": "/etc/passwd"}}),
        "rejected ARCHIVE_LINK",
    ),
    "a tar, a hard link": (
        in_tar(**{"run/b.ckpt": {"type": tarfile.LNKTYPE, "linkname": CHECKPOINT}}),
        "rejected ARCHIVE_LINK",
    ),
    "a tar, a device": (
        in_tar(**{"run/null": {"type": tarfile.CHRTYPE, "devmajor": 1}}),
        "rejected ARCHIVE_SPECIAL_FILE",
    ),
    "a tar, a pipe": (in_tar(**{"run/pipe": {"type": tarfile.FIFOTYPE}}), "rejected ARCHIVE_SPECIAL_FILE"),
    "a tar, a sparse file": (
        in_tar(**{"run/sparse": {"type": tarfile.GNUTYPE_SPARSE}}),
        "rejected ARCHIVE_SPECIAL_FILE",
    ),
    "a tar, a ../ member": (named("run/../../x"), "rejected ARCHIVE_ENTRY_NAME"),
    "a tar, an absolute member": (named("/etc/x"), "rejected ARCHIVE_ENTRY_NAME"),
    "a tar, a name of 600 bytes": (named("run/" + "n" * 600), "rejected ARCHIVE_ENTRY_NAME"),
    "a tar, a name twice": (lambda s: tar_bytes([(CHECKPOINT, s.archive)] * 2), "rejected ARCHIVE_DUPLICATE_ENTRY"),
    "a tar, a member of 2^62 bytes": (huge_member, "rejected ARCHIVE_TOO_LARGE"),
    "a tar, a header with a wrong sum": (
        lambda s: patched(tar_bytes([(CHECKPOINT, s.archive)]), 0, b"X"),
        "rejected ARCHIVE_MALFORMED",
    ),
    "a YAML bomb": (with_settings(BOMB), "rejected SETTINGS_TOO_LARGE"),
    "a YAML value that holds itself": (with_settings("a: &a [*a]"), "rejected SETTINGS_MALFORMED"),
    "YAML with a key twice": (with_settings("a: 1\na: 2\n"), "rejected SETTINGS_MALFORMED"),
    "YAML of two documents": (with_settings("a: 1\n---\nb: 2\n"), "rejected SETTINGS_MALFORMED"),
    "YAML nested 1000 deep": (with_settings("[" * 1000 + "]" * 1000), "rejected SETTINGS_TOO_LARGE"),
    "YAML of 10^6 keys": (
        with_settings(lambda: "".join(f"k{i}: 1\n" for i in range(10**6))),
        "rejected SETTINGS_TOO_LARGE",
    ),
    "YAML that is no text": (with_settings(b"a: \x81\xfe"), "rejected SETTINGS_MALFORMED"),
    "JSON of 10^6 keys": (
        with_settings(lambda: json.dumps({str(i): 1 for i in range(10**6)}), "run/transforms.json"),
        "rejected SETTINGS_TOO_LARGE",
    ),
    "JSON with a key twice": (with_settings('{"a": 1, "a": 2}', "run/transforms.json"), "rejected SETTINGS_MALFORMED"),
    "JSON nested 10^5 deep": (
        with_settings("[" * 10**5 + "]" * 10**5, "run/specs.json"),
        "rejected SETTINGS_TOO_LARGE",
    ),
    "HOCON that includes a file": (
        with_settings('include "/etc/passwd"\nmodel { sdf_network { scale = 1 } }', "run/recording/config.conf"),
        "rejected SETTINGS_UNSAFE",
    ),
    "HOCON that substitutes a value": (
        with_settings("model { sdf_network { scale = ${HOME} } }", "run/recording/config.conf"),
        "rejected SETTINGS_UNSAFE",
    ),
    "HOCON nested 1000 deep": (
        with_settings("a {" * 1000 + "}" * 1000, "run/recording/config.conf"),
        "rejected SETTINGS_TOO_LARGE",
    ),
    "settings that contradict the tensors": (
        with_settings("pipeline: {model: {sdf_field: {num_layers: 2, hidden_dim: 999}}}"),
        "rejected SETTINGS_CONTRADICT_TENSORS",
    ),
    "settings with a text for a number": (
        with_settings("pipeline: {model: {sdf_field: {num_layers: two}}}"),
        "rejected SETTINGS_MALFORMED",
    ),
    "settings with a setting that is not supported": (
        with_settings("pipeline: {model: {sdf_field: {use_grid_feature: true, encoding_type: tensorf_vm}}}"),
        "rejected FAMILY_NOT_SUPPORTED",
    ),
}
