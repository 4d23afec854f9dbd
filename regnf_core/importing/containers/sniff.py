"""What a file seems to be, from its first bytes. Imports nothing: the HTTP front end asks while an upload arrives."""

from __future__ import annotations

import math
import re
import struct
import zlib

from regnf_core.importing.containers.plain_text import is_number, text_alone, unmarked
from regnf_core.importing.containers.refused import is_package, refused

# Whether a file's first bytes are those of a mesh. Some formats have no magic number: their content decides.

MESH_FORMATS = (*("3mf", "e57", "glb", "gltf", "las", "npy", "obj", "pcd", "ply", "step", "stl", "urdf", "usd", "xyz"),)

_MAGICS = ((b"glTF", "glb"), (b"LASF", "las"), (b"ASTM-E57", "e57"), (b"\x93NUMPY", "npy"))
_GLTF_WORDS = (b'"asset"', b'"accessors"', b'"bufferViews"')
_STL_FACETS_AT, _STL_FACET_BYTES = 84, 50
_MAX_STL_FACETS = 1 << 26
_OBJ_NUMBERS = {b"v": 3, b"vn": 3, b"vt": 1}
_OBJ_WORDS = frozenset(
    b"v vt vn vp f fo l p o g s mg mtllib usemtl usemap maplib lod bevel c_interp d_interp shadow_obj trace_obj "
    b"cstype deg bmat step curv curv2 surf parm trim hole scrv sp end con ctech stech call csh".split()
)
"""The statements of the format's specification."""
_USUAL = 0.9
"""Share of a text's lines, or of an STL file's facets, that tell a format: the odd one may be damaged."""
STL_COUNT_OPEN = (0, 0xFFFFFFFF)
_COMMENTS = re.compile(rb"(?:(?:[#;!%]|//)[^\n]*\n\s*)+")
_OBJ_FEW = 8
"""Statements that decide: by then every writer has written one that no other text begins with."""
_LONG_COMMENT = 2048
"""Bytes of comments, and nothing else, before the first statement: of the formats taken only OBJ has such."""
_CONTROL = frozenset(range(32)) - frozenset(b"\t\n\v\f\r")
_NAMED = ((b"PXR-USDC", "usd"), (b"#usda", "usd"), (b"ISO-10303-21", "step"), (b"<robot", "urdf"))
_IFC = re.compile(rb"FILE_SCHEMA *\( *\( *'IFC")
"""A building model in the same file structure: it has no shapes that are read."""
_XML_OWN = re.compile(rb"<\?.*?\?>|<!--.*?-->", re.DOTALL)
"""Of an XML document, what may come before its first element."""


def sniff_mesh(head: bytes) -> str | None:
    """One of MESH_FORMATS, or None. ``head``: the file's beginning, HEAD_BYTES of it or the whole file.

    Text may begin with a byte-order mark, blank lines and comments: the first statement decides, wherever it stands.
    """
    for magic, format_ in _MAGICS:
        if head.startswith(magic):
            return format_
    if _is_binary_stl(head):
        return "stl"
    text = text_alone(head)
    begin = _XML_OWN.sub(b"", text).lstrip() if text.startswith(b"<") else text
    if named := next((format_ for magic, format_ in _NAMED if begin.startswith(magic)), None):
        return None if named == "step" and _IFC.search(head) else named
    if re.match(rb"ply[ \t]*[\r\n]", text, re.IGNORECASE):
        return "splat-ply" if _SPLAT_PROPERTY.search(text) else "ply"
    if text.startswith(b"{") and any(word in text for word in _GLTF_WORDS) and b'"geometricError"' not in text:
        return "gltf"
    if _is_pcd(text):
        return "pcd"
    solid = uncommented(text)
    if solid[:5].lower() == b"solid" and (b"facet" in text.lower() or not _CONTROL & set(text)):
        return "stl"
    if _is_obj(text):
        return "obj"
    return "xyz" if _is_xyz(text) else None


def _statements(text: bytes, comments: tuple[bytes, ...]) -> list[list[bytes]]:
    """The words of each line that is no comment. A last line without an end may be cut off: it does not count, unless
    it is the only one."""
    lines = text.splitlines()
    if len(lines) > 1 and not text.endswith((b"\n", b"\r")):
        lines = lines[:-1]
    return [line.split() for line in lines if line.strip() and not line.lstrip().startswith(comments)]


def _is_pcd(text: bytes) -> bool:
    """Its first line that is not a comment names a version, and then the fields of a point."""
    said = _statements(text, (b"#",))
    named = text.startswith(b"# .PCD") or bool(said and said[0][0] == b"VERSION")
    return named and any(words[0] in (b"FIELDS", b"COLUMNS") for words in said)


def uncommented(text: bytes) -> bytes:
    """Without the lines of comments at the beginning."""
    return _COMMENTS.sub(b"", text)


def _is_xyz(text: bytes) -> bool:
    """Lines of as many numbers each, three at least; the first may be their count alone."""
    if _CONTROL & set(text):
        return False
    said = _statements(text.replace(b",", b" ").replace(b";", b" "), (b"#", b"//", b"%"))
    if said and (names_places(said[0]) or (len(said[0]) == 1 and said[0][0].isdigit())):
        said = said[1:]
    if not said or len(said[0]) < 3 or not all(map(_is_number, said[0][:3])):  # names of columns that are no places
        return False
    # Words behind three numbers may be names; and the odd row may be cut.
    whole = sum(len(words) == len(said[0]) and all(map(_is_number, words[:3])) for words in said)
    return whole == len(said) or whole >= max(_USUAL * len(said), _OBJ_FEW)


def names_places(words: list[bytes]) -> bool:
    """Whether a line is the names of columns, three of which are x, y and z."""
    named = [word.strip(b"\"'").lower() for word in words]
    return all(named.count(axis) == 1 for axis in (b"x", b"y", b"z")) and not any(map(_is_number, words))


def _is_obj(text: bytes) -> bool:
    """Lines that begin with statements of an OBJ file, or comments alone, as far as one can see."""
    if _CONTROL & set(text):
        return False
    every = _statements(text, (b"#",))
    odd = sum(words[0] not in _OBJ_WORDS for words in every)
    if sum(map(_is_place, every)) >= 3 and odd <= max((1.0 - _USUAL) * len(every), 2):  # whatever its first lines are
        return True
    said = every[:_OBJ_FEW]
    if not said:
        return text.startswith(b"#") and (b"obj" in text.lower() or len(text) > _LONG_COMMENT)
    if not all(words[0] in _OBJ_WORDS for words in said):
        return False
    # A single short word begins many a text: one line alone has to say all that its statement needs.
    needed = _OBJ_NUMBERS.get(said[0][0])
    if needed is not None:
        return len(said[0]) > needed and all(map(_is_number, said[0][1:]))
    return len(said) > 1 or len(said[0]) > 1


def _is_place(words: list[bytes]) -> bool:
    """Whether a line of an OBJ file is a vertex or a face."""
    if words[0] == b"v":
        return len(words) > 3 and all(map(_is_number, words[1:4]))
    return words[0] in (b"f", b"fo") and len(words) > 3 and all(word[:1] in b"-0123456789" for word in words[1:4])


def _is_number(word: bytes) -> bool:
    """Also with a decimal comma, which the reader then names."""
    return is_number(word.replace(b",", b"."))


def _is_binary_stl(head: bytes) -> bool:
    """Facets whose corners are ordinary numbers, but for a few. Some writers leave their count open."""
    facets = (len(head) - _STL_FACETS_AT) // _STL_FACET_BYTES
    claimed = int.from_bytes(head[80:84], "little")
    if claimed in STL_COUNT_OPEN:
        claimed = facets if facets >= _OBJ_FEW else 0
    facets = min(facets, claimed)
    if facets < 1 or claimed > _MAX_STL_FACETS:
        return False
    each = (struct.unpack_from("<12f", head, _STL_FACETS_AT + _STL_FACET_BYTES * at) for at in range(facets))
    return sum(map(_is_facet, each)) >= _USUAL * facets


def _is_facet(values: tuple[float, ...]) -> bool:
    """Of a normal and three corners. Normals are of any length, or none; corners are some numbers, not all zero."""
    sizes = [abs(value) for value in values[3:]]
    return all(size == 0.0 or 1e-20 < size < 1e9 for size in sizes) and any(sizes)


# Gaussian splats. Two of their formats have no magic number.

GAUSSIANS = b"KHR_gaussian_splatting"
"""The extension of glTF files that hold splats."""
MARKED_BYTES = 1 << 20
"""In which it stands, by the order of all writers."""
SPLAT_FORMATS = ("splat-ply", "splat", "ksplat", "spz", "sog")
_SPLAT_PROPERTY = re.compile(rb"property \w+ (f_dc_0|packed_position)\s")
_SPLAT_ROW = struct.Struct("<6f8B")
_KSPLAT = struct.Struct("<2BxxIIIIH")
_NGSP = b"NGSP"
_MOST_SECTIONS, _SPLAT_ROWS = 1024, 8


def sniff_splats(head: bytes) -> str | None:
    """One of SPLAT_FORMATS, or None: PLY files are told by their header, see ``sniff_mesh``."""
    if head.startswith(_NGSP):
        return "spz"
    text = unmarked(head)
    if text.startswith(b"{") and b'"means"' in text and b'"scales"' in text:
        return "sog"
    if len(head) >= HEAD_BYTES and head[:1] == b"\0":
        major, minor, most, sections, splats, count, level = _KSPLAT.unpack_from(head)
        told = (major, minor) == (0, 1) and 0 < sections <= most <= _MOST_SECTIONS
        return "ksplat" if told and 0 < count <= splats and level <= 2 else None
    return "splat" if _is_splat(head) else None


def splat_format(data: bytes | memoryview) -> str | None:
    """The format in which a whole file holds Gaussian splats, one of SPLAT_FORMATS, "glb" or "gltf"; None: in none."""
    kind = sniff_format(bytes(data[:HEAD_BYTES]))
    if kind in SPLAT_FORMATS:
        return kind
    return kind if kind in ("glb", "gltf") and GAUSSIANS in bytes(data[:MARKED_BYTES]) else None


def _is_splat(head: bytes) -> bool:
    """Rows of 32 bytes: numbers of a place, three lengths, and a quaternion of length one in bytes."""
    if len(head) < _SPLAT_ROWS * _SPLAT_ROW.size or (len(head) < HEAD_BYTES and len(head) % _SPLAT_ROW.size):
        return False
    for row in range(_SPLAT_ROWS):
        *values, _, _, _, _, w, x, y, z = _SPLAT_ROW.unpack_from(head, _SPLAT_ROW.size * row)
        place, scales = values[:3], values[3:]
        length = math.hypot(*(part / 128.0 - 1.0 for part in (w, x, y, z)))
        if not all(math.isfinite(value) and abs(value) < 1e6 for value in place) or abs(length - 1.0) > 0.03:
            return False
        if not all(math.isfinite(value) and 1e-12 < value < 1e4 for value in scales):
            return False
    return True


def _packed_format(head: bytes) -> str | None:
    """What a file packed by gzip holds, if it is no archive."""
    try:
        start = zlib.decompressobj(31).decompress(head, _START)
    except zlib.error:
        return None
    return "spz" if start.startswith(_NGSP) else "instant-ngp" if _SNAPSHOT.match(start) else None


_START = 64
_SNAPSHOT = re.compile(
    rb"(?:[\x81-\x8f]|\xde..)[\xa1-\xbf](?:aabb|[a-z_]*encoding|distortion_map|envmap|loss)", re.DOTALL
)
"""A map of MessagePack that begins with one of the keys of instant-ngp's snapshots, in the order of the alphabet."""


HEAD_BYTES = 4096
"""How many first bytes are looked at: text may have a license before its first statement."""

_SQLITE_MAGIC = b"SQLite format 3\x00"
_ZIP_LOCAL_HEADER = b"PK\x03\x04"
_ZIP_NAME_AT = 30
_TORCH_MEMBERS = frozenset(
    b"data.pkl data .data version byteorder .format_version .storage_alignment constants.pkl code".split()
)
_ONNX = re.compile(rb"\x08[\x03-\x1f](?!\x12[\x80-\xff]*[\x01-\x7f]\n)[\x12\x1a\x22\x28\x32\x3a\x42]")
"""A protocol buffer whose first field is the version of ONNX's format, and whose second is one of a model's. Core ML's
has a message there, which begins with its first field, where ONNX has a name."""
_PACKAGES = ((b"[Content_Types].xml", "3mf"), (b"_rels/", "3mf"), (b"3D/", "3mf"))
"""The first member of zip files that are a model, or an office document: what they are read as."""
_LEGACY_MAGIC = b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19."
RUN_ARCHIVES = frozenset({"zip", "tar", "gzip", "bzip2", "xz"})
"""Formats in which a whole training run may be given."""
_PACKED = ((b"\x1f\x8b\x08", "gzip"), (b"BZh", "bzip2"), (b"\xfd7zXZ\x00", "xz"))
_TAR_MAGIC, _TAR_MAGIC_AT, _OLD_TORCH_TAR = b"ustar", 257, b"sys_info\0"
BAGS = (b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n")
"""How recordings of robots begin, beside those that are SQLite databases."""
RECORDINGS = (*BAGS, _ZIP_LOCAL_HEADER)
"""How files begin that may be recordings, whatever else they look like."""


def sniff_format(head: bytes) -> str | None:
    """``"torch-zip"``, ``"torch-legacy"``, ``"safetensors"``, ``"npz"``, ``"sqlite"``, ``"onnx"``, ``"instant-ngp"``, a
    mesh's format, one of ``SPLAT_FORMATS`` or of ``RUN_ARCHIVES``, or None for what is not taken.

    ``head`` is the file's beginning, HEAD_BYTES of it or the whole file if it is shorter. A name promises nothing
    about the rest of the file.
    """
    if head.startswith(_ZIP_LOCAL_HEADER) and _may_be_torch_archive(head):
        return "torch-zip"
    if head.startswith(_LEGACY_MAGIC):
        return "torch-legacy"
    if head.startswith(_ZIP_LOCAL_HEADER):
        if _first_name(head).endswith(b".npy"):
            return "npz"
        return _package(_first_name(head)) or (None if is_package(head) else "zip")
    if head[_TAR_MAGIC_AT:].startswith(_TAR_MAGIC):
        return None if head.startswith(_OLD_TORCH_TAR) else "tar"
    for magic, packing in _PACKED:
        if head.startswith(magic):
            return (_packed_format(head) if packing == "gzip" else None) or packing
    if _SNAPSHOT.match(head):
        return "instant-ngp"
    if head.startswith(_SQLITE_MAGIC):
        return "sqlite"
    if (splats := sniff_splats(head)) is not None:
        return splats
    if head[8:9] == b"{" and head[9:10] != b"\0" and b"\0" in head[:8]:  # the length of its header; no text has zeros
        return "safetensors"
    return "onnx" if _ONNX.match(head) else sniff_mesh(head)


def explain_refusal(head: bytes, name: str = "") -> tuple[str, str]:
    """The reason and a sentence for a file that ``sniff_format`` does not name. name: of the file, where it is known;
    it is asked where the bytes tell nothing."""
    if not head:
        return "FILE_EMPTY", "the file is empty"
    if head.startswith(_OLD_TORCH_TAR):
        return "LEGACY_TORCH_FILE", "a tar archive of PyTorch before version 0.1.10; save it again"
    if head[:1] == b"\x80" and head[1:2] in (b"\x02", b"\x03", b"\x04", b"\x05"):
        return "RAW_PICKLE", "a plain pickle; only files written by torch.save (1.6 or later) are supported"
    ending = name.lower().rpartition(".")[2]
    if (told := refused(head, name)) is None and ending in MESH_FORMATS:
        return "FORMAT_NOT_RECOGNIZED", f"by its name a .{ending} file, but its content is not; copy or export it again"
    return told or (
        "FORMAT_NOT_RECOGNIZED",
        "not a supported format; supported are torch.save files, safetensors, npz, SQLite, ONNX, meshes, archives of "
        "a run",
    )


def _package(first: bytes) -> str | None:
    """The format of a zip with this first member that is no run, but a model of one file."""
    if first.lower().endswith((b".usd", b".usda", b".usdc")):
        return "usd"
    return next((format_ for name, format_ in _PACKAGES if first.startswith(name)), None)


def _first_name(head: bytes) -> bytes:
    return head[_ZIP_NAME_AT : _ZIP_NAME_AT + int.from_bytes(head[26:28], "little")]


def _may_be_torch_archive(head: bytes) -> bool:
    """Whether the first entry's name fits torch.save: <archive>/<member>. A head cut short gets the benefit."""
    name_end = _ZIP_NAME_AT + int.from_bytes(head[26:28], "little")
    if len(head) < name_end:
        return True
    parts = head[_ZIP_NAME_AT:name_end].split(b"/")
    return len(parts) >= 2 and parts[1] in _TORCH_MEMBERS
