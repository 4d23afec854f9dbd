"""Files that are not read: how they begin, what they are, what to give instead. Imports the standard library alone."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache

from regnf_core.importing.containers.plain_text import unmarked

_INSTEAD = {
    "archive": "unpack it, and give the file in it",
    "bag": "upload it with POST /recordings",
    "cameras": "give them with --cameras, beside the field",
    "cloud": "export it as .las, .ply or .pcd",
    "code": "give the file that it makes",
    "failed": "the download failed, or it needs a login",
    "flat": "a map of one height has no surface in 3D; give the 3D map, a mesh or the recording from which it was made",
    "lfs": "run `git lfs pull`, then give it again",
    "map": "save its surface as a mesh, or sample it on a dense grid in .npz",
    "names": "convert the meshes that it names, or export it as .glb, .ply, .obj or .stl",
    "network": "export the network as ONNX",
    "hdf5": "export the network as ONNX, or save its arrays with numpy.savez",
    "none": "expected a field: a checkpoint, a regnf field file, a mesh or a grid",
    "octree": "give the .las, .laz or .ply file from which it was made",
    "onnx": "give the .onnx file from which it was made",
    "shape": "export it as .glb, .ply, .obj or .stl",
    "table": "remove the line of names: lines of numbers x y z are a cloud",
    "video": "give its images and camera poses as a recording",
    "zeros": "it was not written to its end; copy it again",
    "material": "give the .obj file that refers to it",
    "columns": "read it with numpy.fromfile, and save x, y, z with numpy.save",
    "volume": "save it in .npz: numpy.savez(file, sdf=array, origin=..., spacing=...)",
    "xml": "export a model as .glb, .ply, .obj or .stl",
}
"""What to do about a file, by the first word of its row."""
_NO_FIELD = frozenset(
    ["archive", "bag", "cameras", "code", "failed", "hdf5", "lfs", "material", "none", "video", "xml", "zeros"]
)
"""Files that hold no field: FORMAT_NOT_RECOGNIZED; of the others FORMAT_NOT_SUPPORTED."""
_ROWS = r"""
shape    a STEP model of CAD              .step .stp        ISO-10303-21(?!.*FILE_SCHEMA ?\( ?\( ?'IFC)
shape    an IFC building model            .ifc              ISO-10303-21.*FILE_SCHEMA ?\( ?\( ?'IFC
shape    an IGES model of CAD             .iges .igs        [^\n]{72}S[ 0]{6}1
shape    a Parasolid model of CAD         .x_t .x_b         \*\*ABCDEFGHIJKLMNOPQRSTUVWXYZ|PS\0\0
shape    an ACIS model of CAD             .sat .sab         (ACIS|ASM) BinaryFile|\d+ \d+ \d+ \d+ [^\n]*ACIS
shape    a JT model of CAD                .jt               Version \d+\.\d+ .{0,16}JT
shape    a CATIA model of CAD             .catpart          V5_CFV2
shape    a Creo model of CAD              .prt .asm         #UGC:2
shape    an OpenCASCADE model of CAD      .brep             DBRep_DrawableShape|CASCADE Topology
shape    a FreeCAD document               .fcstd            PK\x03\x04.{26}Document\.xml
shape    a CAD or office document         .sldprt .ipt .max  \xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1
shape    a Rhino file                     .3dm              3D Geometry File Format
shape    a SketchUp model                 .skp              \xff\xfe\xff\x0eS\0k\0e\0t\0c\0h\0U\0p
shape    a DWG drawing                    .dwg              AC10\d\d
shape    a DXF drawing                    .dxf              (999 .{0,200}?)?0 SECTION 2 |AutoCAD Binary DXF
shape    a U3D or PRC model               .u3d .prc         U3D\0|PRC[\0-\x1f]
shape    a USD scene                      .usd .usda .usdc  PXR-USDC|#usda
shape    a USDZ scene                     .usdz             PK\x03\x04.{26}[^\0]*?\.usd[ac]?(?![^\0]*/)
shape    a 3MF model or office document   .3mf              PK\x03\x04.{26}(\[Content_Types\]\.xml|3D/)
shape    a KMZ or OpenDocument file       .kmz .odt         PK\x03\x04.{26}(doc\.kml|mimetype)
shape    an FBX scene                     .fbx              Kaydara FBX|; FBX\x20
shape    a Blender file                   .blend            BLENDER
shape    a 3DS scene                      .3ds              MM.{4}(\x02\0\x0a\0\0\0|==)
shape    a LightWave or Modo scene        .lwo .lxo         FORM.{4}(LWO|LXO)
shape    a Maya scene                     .ma .mb           //Maya ASCII|FOR4.{4}Maya|FOR8.{12}Maya
shape    a Cinema 4D scene                .c4d              QC4DC4D6
shape    a Unity asset                    .prefab .unity    %YAML \S+ %TAG !u!|UnityFS
shape    an Unreal asset                  .uasset           \xc1\x83\x2a\x9e
shape    a Godot scene                    .tscn .scn        \[gd_scene|RSRC
shape    an Alembic scene                 .abc              Ogawa
shape    a Houdini scene                  .bgeo             \x7fNSJ|PGEOMETRY
shape    a DirectX model                  .x                xof 0
shape    a model of a game                .md2 .md3 .ms3d   IDP[23]|MS3D0
shape    an AC3D model                    .ac               AC3D
shape    a VRML scene                     .wrl              #VRML
shape    an X3D scene                     .x3d              #X3D|<X3D
shape    an Open Inventor scene           .iv               #Inventor
shape    a COLLADA scene                  .dae              <COLLADA
shape    a city model                     .gml .kml         <(core:)?CityModel|<kml
shape    a CityJSON model                 .city.json        \{"CityJSON"
shape    an AMF model                     .amf              <amf
shape    an OFF mesh                      .off              (#[^\n]*\n\s*)*[STCN4n]{0,6}OFF(?![A-Z])
shape    an OpenCTM mesh                  .ctm              OCTM
shape    a Draco mesh                     .drc              DRACO
shape    an ANSYS Fluent mesh             .msh              \([01] "|\(2 [23]\)
shape    a Gmsh mesh                      .msh              \$MeshFormat|\$NOD
shape    a Medit mesh                     .meshb            MeshVersionFormatted
shape    a Nastran model                  .nas .bdf         (\$[^\n]*\n\s*)*(SOL \d|CEND|BEGIN BULK|GRID[*, ])
shape    an LS-DYNA model                 .k                (\$[^\n]*\n\s*)*\*KEYWORD
shape    an Abaqus model                  .inp              (\*\*[^\n]*\n\s*)*\*(HEADING|NODE|PART)\b
shape    a VTK file                       .vtk .vtu .vtp    # vtk DataFile|<VTKFile
shape    an XDMF file                     .xdmf             <Xdmf
shape    an Exodus or netCDF file         .exo .nc          CDF[\x01\x02\x05]
names    a URDF robot                     .urdf .xacro      <robot
names    a Gazebo model                   .sdf              <sdf
names    a MuJoCo model                   .mjcf             <mujoco
volume   an NRRD volume                   .nrrd             NRRD000
volume   a NIfTI volume                   .nii              .{344}n[+i]1\0|.{4}n[+i]2\0
volume   a MetaImage volume               .mha .mhd         ObjectType = Image|NDims = \d
volume   a DICOM image                    .dcm              .{128}DICM
volume   an MRC volume                    .mrc              .{208}MAP\x20
volume   an Amira volume                  .am               # (AmiraMesh|Avizo)
volume   a binvox grid                    .binvox           #binvox
volume   a MagicaVoxel model              .vox              VOX [\x80-\xff]\0\0\0
volume   a MATLAB file                    .mat              MATLAB [57]\.
volume   a raw volume                     .raw
map      an OpenVDB or NanoVDB file       .vdb .nvdb        \x20BDV|NanoVDB
map      an OctoMap                       .bt .ot           # Octomap
map      a Voxblox map                    .vxblx            .{2,6}\x09.{8}\x10.\x1a.(tsdf|esdf|occupancy)
map      a Cartographer map               .pbstream         \xdb\x01\xf5\x5b\x7b\x1f\x1d\x7b
flat     a ROS map of one height          .pgm              image: .*resolution: .*origin:|P[25]\s
cloud    a PTX cloud of points            .ptx              \d+\s+\d+\s+([-+.\de]+ [-+.\de]+ [-+.\de]+\s){3}
cloud    a cloud of ReCap                 .rcp .rcs
cloud    a cloud of Faro                  .fls .lsproj
cloud    a cloud of Zoller+Froehlich      .zfs .zfprj
cloud    a cloud of Pointools             .pod
cloud    a cloud of 3D Tiles              .pnts             pnts\x01\0{3}
shape    a model of 3D Tiles              .b3dm .i3dm .cmpt  (b3dm|i3dm|cmpt)\x01\0{3}
octree   an index of 3D Tiles             tileset.json      \{"geometricError"
octree   a Potree or Entwine index        ept.json             \{"(hierarchyType|firstChunkSize|octreeDir)"
octree   a part of a Potree cloud         octree.bin
cloud    a table of columns               .parquet .feather  PAR1|FEA1|ARROW1
table    a table with column names        .csv              [a-z_"][\w".]*([,; \t]+[\w".]+)+\s*\n[-+.\de,; \t]+\r?\n
network  a Keras model                    .keras            PK\x03\x04.{26}(metadata|config|model\.weights)\.
hdf5     an HDF5 file, as of Keras        .h5 .hdf5         \x89HDF
hdf5     a TensorFlow model               .pb               \x08\x01\x12
network  a TensorFlow Lite model          .tflite           .{4}TFL3
network  a Core ML model                  .mlmodel          \x08[\x01-\x1f]\x12[\x80-\xff]*[\x01-\x7f]\x0a
network  an OpenVINO model                -                 <net\x20
network  a language model                 .gguf             GGUF
network  an instant-ngp snapshot          .msgpack .ingp    [\x81-\x8f][\xa1-\xbf](aabb|[a-z_]*encoding|loss)
network  a Flax checkpoint                .flax             [\x81-\x8f][\xa1-\xbf](params|step|opt_state)
onnx     a TensorRT engine                .engine .trt      [fp]trt
onnx     a model of ONNX Runtime          .ort              .{4}ORTM
bag      a recording of a robot           .bag .mcap        \x89MCAP0\r\n|#ROSBAG V
video    a recording of a ZED camera      .svo .svo2
none     a PNG picture                    .png              \x89PNG
none     a JPEG picture                   .jpg .jpeg        \xff\xd8\xff
none     a TIFF picture                   .tif .tiff        II[*+]\0|MM\0[*+]
none     an EXR picture                   .exr              v/1\x01
none     a WebP picture                   .webp             RIFF.{4}WEBP
none     a GIF picture                    .gif              GIF8
none     a HEIC or AVIF picture           .heic .avif       .{4}ftyp(hei|hev|mif|avi)
none     a picture                        .bmp .psd .jp2    BM.{4}\0{4}|8BPS|\0{3}\x0cjP|P[1346F]\s|DDS\x20|.KTX
none     an SVG picture                   .svg              <svg
video    a video                          .mp4 .avi .mkv    .{4}(ftyp|moov)|RIFF.{4}AVI\x20|\x1aE\xdf\xa3|\0\0\x01\xba
none     a sound                          .wav .mp3         RIFF.{4}WAVE|ID3|OggS|fLaC
zeros    a file of zeros                  -                 \0{64}
material  a file of materials             .mtl              (#[^\n]*\n\s*)*newmtl\s
shape    an OpenSCAD program              .scad
shape    a program of a milling machine   .gcode .nc        (;[^\n]*\n\s*)*G(0|1|21|28|90)\b
columns  a raw array of numbers           .bin
lfs      a Git LFS pointer, not the file itself  -                 version https://git-lfs
failed   an HTML page, not a field        .html             <!doctype html|<html
none     a PDF document                   .pdf .ps          %PDF|%!PS|\{\\rtf
archive  a 7z archive                     .7z               7z\xbc\xaf
archive  a RAR archive                    .rar              Rar!\x1a
archive  a Zstandard archive              .zst              \x28\xb5\x2f\xfd
archive  an LZ4 archive                   .lz4              \x04\x22\x4d\x18
archive  an archive                       .cab .lz .Z       MSCF|LZIP|\x1f[\x9d\xa0]|!<arch>|PK(\x05\x06|\x07\x08)
code     a program                        .so .exe .dll     \x7fELF|MZ.{58}|[\xce\xcf]\xfa\xed\xfe
code     a script                         .py .sh           #!|(import|from) [a-z_.]+( import| as)?\b[^\n]*\n
cameras  camera poses                     -                 \{"camera_(model|angle_x)"|\{"transform_matrix"
none     a JSON document                  .json             \{\s*("|\}|$)|\[\s*[\[{"\d]
none     a YAML document                  .yaml .yml        (#[^\n]*\n|%YAML[^\n]*\n)*(---\s|[a-z_]\w*:\s)
xml      an XML document                  .xml              <\?xml
"""
"""Word of ``_INSTEAD``, what it is, ends of names (-: none), and a pattern of the beginning, two blanks between them. A
pattern is tried on the first bytes as they are, and with each white space a single blank, small letters like large
ones. One that begins with `<` or `{` is a tag, or a key, anywhere in XML or JSON. The first row that fits decides."""


@dataclass(frozen=True)
class _Row:
    """A format. ends: of names · begins: None where the first bytes do not tell it · is_tag: whether it may stand
    anywhere in XML or JSON."""

    kind: str
    name: str
    ends: tuple[str, ...]
    begins: re.Pattern[bytes] | None
    is_tag: bool

    def fits(self, head: bytes, words: bytes) -> bool:
        """words: the first bytes with each white space a single blank."""
        if self.begins is None:
            return False
        if self.is_tag and words[:1] in (b"<", b"{"):
            return self.begins.search(words) is not None
        return (self.begins.match(head) or self.begins.match(words)) is not None

    def told(self, by_name: bool = False) -> tuple[str, str]:
        """The reason and a sentence."""
        if by_name and self.begins is not None:
            return "FORMAT_NOT_RECOGNIZED", f"by its name {self.name}, but its content is not; copy or export it again"
        reason = "FORMAT_NOT_RECOGNIZED" if self.kind in _NO_FIELD else "FORMAT_NOT_SUPPORTED"
        return reason, f"{self.name}; {_INSTEAD[self.kind]}"


@cache
def _rows() -> tuple[_Row, ...]:
    """The formats, in the order in which they are tried."""
    found = []
    for line in _ROWS.strip().splitlines():
        kind, name, ends, *pattern = re.split("  +", line)
        is_tag = bool(pattern) and ("<" in pattern[0] or r'\{"' in pattern[0])
        begins = "".join(pattern).replace(r'\{"', '"') if is_tag else "".join(pattern)
        compiled = re.compile(begins.encode(), re.IGNORECASE | re.DOTALL) if begins else None
        found.append(_Row(kind, name, tuple(ends.strip("-").split()), compiled, is_tag))
    return tuple(found)


def refused(head: bytes, name: str = "") -> tuple[str, str] | None:
    """The reason and a sentence for a file of a known format, by its beginning, or else by the end of its name."""
    start = unmarked(head)
    words = b" ".join(start.split())
    rows = _rows()
    by_content = next((row for row in rows if row.fits(head, words) or row.fits(start, words)), None)
    if by_content is not None:
        return by_content.told()
    ended = next((row for row in rows if name.lower().endswith(row.ends)), None)
    return None if ended is None else ended.told(by_name=True)


def named_file(name: str) -> str | None:
    """What a file of this name is, and what to do about it, where that alone tells it; of an archive's members."""
    row = next((row for row in _rows() if name.lower().endswith(row.ends)), None)
    return None if row is None or row.kind in _NO_FIELD else f"{row.name}; {_INSTEAD[row.kind]}"


def is_package(head: bytes) -> bool:
    """Whether a zip file, by its first member, is a model of another program and no training run."""
    zips = (row.begins for row in _rows() if row.begins is not None and row.begins.pattern.startswith(b"PK"))
    return any(pattern.match(head) for pattern in zips)
