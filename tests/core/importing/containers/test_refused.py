"""Files that are not read are named. Beginnings are made by hand, after the formats' published magic numbers."""

from __future__ import annotations

import io
import struct
import zipfile

import numpy as np
import pytest

from regnf_core.importing.containers.refused import _rows, refused
from regnf_core.importing.containers.sniff import HEAD_BYTES, explain_refusal, sniff_format

_GENERIC = "not a supported format"


def _zip(first: str) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr(first, "x")
    return packed.getvalue()


def _at(place: int, magic: bytes) -> bytes:
    return bytes(place) + magic


def _riff(kind: bytes) -> bytes:
    return b"RIFF" + struct.pack("<I", 1000) + kind


def _box(kind: bytes) -> bytes:
    return struct.pack(">I", 24) + b"ftyp" + kind


_PTX = b"4\r\n2\r\n0 0 0\r\n1 0 0\r\n0 1 0\r\n0 0 1\r\n1 0 0 0\r\n0 1 0 0\r\n0 0 1 0\r\n0 0 0 1\r\n0.5 1 2 0.3\r\n"
_IGES = b"a drawing".ljust(72) + b"S      1\n" + b"1H,,1H;,4HSLOT".ljust(72) + b"G      1\n"
_LAYER = b"\x09" + struct.pack("<d", 0.05) + b"\x10\x10\x1a\x04tsdf"
_VOXBLOX = b"\x03" + bytes([len(_LAYER)]) + _LAYER + b"\x80\x40\x08\x10"
_STEP = b"ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION(('a'),'2;1');\nFILE_SCHEMA(('%s'));\n"
SHAPES: list[tuple[bytes, str]] = [
    (_STEP % b"IFC4", "IFC"),
    (_IGES, "IGES"),
    (b"**ABCDEFGHIJKLMNOPQRSTUVWXYZ" + b"*" * 50 + b"\n**PARASOLID", "Parasolid"),
    (b"PS\0\0\0\x3f: TRANSMIT FILE", "Parasolid"),
    (b"700 0 1 0 \n16 SolidWorks(2019) 11 ACIS 7.0 NT 24 Mon\n1 9.9e-07 1e-10\n", "ACIS"),
    (b"ACIS BinaryFile\xbc\x02", "ACIS"),
    (b"Version 9.5 JT  DM 6.3.1.0".ljust(75) + b"\r\n", "JT"),
    (b"V5_CFV2\0\0\0\x10", "CATIA"),
    (b"#UGC:2 PART 1187 550", "Creo"),
    (b"DBRep_DrawableShape\n\nCASCADE Topology V1, (c)", "OpenCASCADE"),
    (_zip("Document.xml"), "FreeCAD"),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(16), "CAD or office"),
    (b"3D Geometry File Format       70", "Rhino"),
    (b"\xff\xfe\xff\x0e" + "SketchUp Model".encode("utf-16-le"), "SketchUp"),
    (b"AC1032\0\0", "DWG"),
    (b"  0\r\nSECTION\r\n  2\r\nHEADER\r\n", "DXF"),
    (b"AutoCAD Binary DXF\r\n\x1a\0", "DXF"),
    (b"U3D\0\x18\0\0\0", "U3D"),
    (_zip("doc.kml"), "KMZ"),
    *((b"Kaydara FBX Binary  \0\x1a\0", "FBX"), (b"; FBX 7.3.0 project file\n", "FBX")),
    (b"BLENDER-v300REND", "Blender"),
    (b"MM" + struct.pack("<IHI", 5000, 2, 10) + b"\x03\0\0\0", "3DS"),
    *((b"FORM\0\0\1\0LWO2TAGS", "LightWave"), (b"FORM\0\0\1\0LXOBVRSN", "Modo")),
    *((b"//Maya ASCII 2022 scene\n", "Maya"), (b"FOR4\0\0\1\0MayaFOR4", "Maya")),
    (b"FOR8" + bytes(12) + b"MayaFOR8", "Maya"),
    (b"QC4DC4D6\0\0", "Cinema 4D"),
    *((b"%YAML 1.1\n%TAG !u! tag:unity3d.com,2011:\n", "Unity"), (b"UnityFS\0\0\0\0\x06", "Unity")),
    (b"\xc1\x83\x2a\x9e\xf9\xff\xff\xff", "Unreal"),
    *((b"[gd_scene load_steps=2 format=3]\n", "Godot"), (b"Ogawa\xff\0\1", "Alembic")),
    *((b"\x7fNSJb\0\0\0", "Houdini"), (b"xof 0303txt 0032\n", "DirectX")),
    *((b"IDP2\x08\0\0\0", "game"), (b"AC3Db\n", "AC3D"), (b"#VRML V2.0 utf8\n", "VRML")),
    *((b"#X3D V3.0 utf8\n", "X3D"), (b"<?xml version='1.0'?>\n<X3D profile='Full'>", "X3D")),
    (b"#Inventor V2.1 ascii\n", "Open Inventor"),
    (b"\xef\xbb\xbf<?xml version='1.0'?>\n<COLLADA version='1.4.1'>", "COLLADA"),
    (b"<?xml version='1.0'?>\n<core:CityModel xmlns='x'>", "city"),
    (b'{"type": "CityJSON", "version": "1.1"}'.replace(b'"type": ', b'"CityJSON": 1, "type": '), "CityJSON"),
    (b"<?xml version='1.0'?>\n<amf unit='millimeter'>", "AMF"),
    *((b"OFF\n8 6 12\n", "OFF"), (b"OFF8 12 0\n", "OFF"), (b"# a license\n\nSTCNOFF\n8 12 0\n", "OFF")),
    *((b"COFF BINARY\n", "OFF"), (b"OCTM\x05\0\0\0RAW\0", "OpenCTM"), (b"DRACO\x02\x02\x01", "Draco")),
    *((b"$MeshFormat\n4.1 0 8\n", "Gmsh"), (b"MeshVersionFormatted 2\nDimension 3\n", "Medit")),
    *((b"$ made by hand\nSOL 101\nCEND\n", "Nastran"), (b"GRID*   1               0\n", "Nastran")),
    *((b"*KEYWORD\n*NODE\n", "LS-DYNA"), (b"** job\n*HEADING\n", "Abaqus"), (b"*Node\n 1, 0., 0., 0.\n", "Abaqus")),
    *((b"# vtk DataFile Version 3.0\n", "VTK"), (b'<?xml version="1.0"?>\n<VTKFile type="PolyData">', "VTK")),
    *((b'<?xml version="1.0"?>\n<Xdmf Version="3.0">', "XDMF"), (b"CDF\x02\0\0\0\0", "netCDF")),
    *((b"<!-- made by hand -->\n<sdf version='1.7'>", "Gazebo"), (b"<mujoco model='a'>", "MuJoCo")),
    *((b"NRRD0004\ntype: float\n", "NRRD"), (_at(344, b"n+1\0"), "NIfTI"), (b"\x1c\2\0\0n+2\0\r\n", "NIfTI")),
    *((b"ObjectType = Image\nNDims = 3\n", "MetaImage"), (_at(128, b"DICM\2\0"), "DICOM")),
    *((_at(208, b"MAP DD\0\0"), "MRC"), (b"# AmiraMesh BINARY-LITTLE-ENDIAN 2.1\n", "Amira")),
    *((b"#binvox 1\ndim 32 32 32\n", "binvox"), (b"VOX \x96\0\0\0MAIN", "MagicaVoxel")),
    *((b"MATLAB 5.0 MAT-file, Platform: PCWIN64", "MATLAB"), (b"MATLAB 7.3 MAT-file, Platform", "MATLAB")),
    *((b" BDV\0\0\0\0\xe0\0\0\0", "OpenVDB"), (b"NanoVDB2" + bytes(40), "NanoVDB")),
    *((b"# Octomap OcTree binary file\n", "OctoMap"), (b"# Octomap OcTree file\nid ColorOcTree\n", "OctoMap")),
    *((_VOXBLOX, "Voxblox"), (b"\xdb\x01\xf5\x5b\x7b\x1f\x1d\x7b\x10", "Cartographer")),
    (b"image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\n", "one height"),
    (b"P5\n# CREATOR: map_saver.cpp 0.050 m/pix\n384 384\n255\n", "one height"),
    *((_PTX, "PTX"), (b"pnts\x01\0\0\0\0\1\0\0", "3D Tiles"), (b"b3dm\x01\0\0\0\0\1\0\0", "3D Tiles")),
    (b'{"asset": {"version": "1.0"}, "geometricError": 500}', "index of 3D Tiles"),
    (b'{"version": "2.0", "points": 9, "hierarchy": {"firstChunkSize": 22}}', "Potree"),
    (b'{"bounds": [0], "hierarchyType": "json"}', "Entwine"),
    *((b"PAR1\x15\x04", "columns"), (b"ARROW1\0\0", "columns")),
    *((b"lon,lat,h\n" + 99 * b"1,2,3\n", "column names"), (b"E N H Intensity\r\n0.5 1 2 7\r\n", "column names")),
    *((b"; made by a slicer\nG28 ; home\n", "milling"), (b'(1 "meshio 5.3.5")\n(2 3)\n', "Fluent")),
    *((b"NCOFF\n32 60 0\n", "OFF"), (b"999\nDXF by a library\n0\nSECTION\n2\nHEADER\n", "DXF")),
    *((_zip("config.json"), "Keras"), (_zip("metadata.json"), "Keras"), (b"\x1c\0\0\0TFL3", "TensorFlow Lite")),
    *(
        (b"\x08\x05\x12\x90\x01\x0a\x10\x0a\x05image", "Core ML"),
        (b"<?xml version='1.0'?>\n<net name='a'>", "OpenVINO"),
    ),
    *((b"GGUF\x03\0\0\0", "language model"), (b"\x82\xa6params\x81", "Flax")),
    *((b"ftrt\0\0\0\0", "TensorRT"), (b"\x20\0\0\0ORTM", "ONNX Runtime")),
]
OTHERS: list[tuple[bytes, str]] = [
    *((b"\x89HDF\r\n\x1a\n", "HDF5"), (b"\x08\x01\x12\xf0", "TensorFlow model")),
    *((b"\x89MCAP0\r\n", "POST /recordings"), (b"#ROSBAG V2.0\n", "POST /recordings")),
    *((b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "PNG"), (b"\xff\xd8\xff\xe0\0\x10JFIF", "JPEG"), (b"II*\0\x08", "TIFF")),
    *((b"MM\0*\0\0\0\x08", "TIFF"), (b"v/1\x01\x02\0\0\0", "EXR"), (_riff(b"WEBPVP8 "), "WebP"), (b"GIF89a", "GIF")),
    *((_box(b"heic"), "HEIC"), (b"8BPS\0\1", "picture"), (b"P6\n640 480\n255\n", "picture")),
    (b"<?xml version='1.0'?><svg/>", "SVG"),
    *(
        (_box(b"isom"), "video"),
        (_riff(b"AVI LIST"), "video"),
        (b"\x1aE\xdf\xa3\x01", "video"),
        (_riff(b"WAVEfmt "), "sound"),
    ),
    *((b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"), (b"<!DOCTYPE html>\n<html>", "HTML")),
    *((b"%PDF-1.7\n", "PDF"), (b"7z\xbc\xaf\x27\x1c", "7z"), (b"Rar!\x1a\x07\x01\0", "RAR")),
    *((b"\x28\xb5\x2f\xfd\x04", "Zstandard"), (b"\x04\x22\x4d\x18\x64", "LZ4"), (b"MSCF\0\0", "archive")),
    *((b"\x7fELF\x02\x01\x01", "program"), (b"MZ" + bytes(62), "program"), (b"#!/bin/sh\nset -e\n", "script")),
    *((b"import numpy as np\n", "script"), (b"from pathlib import Path\n", "script")),
    *((b'{"frames": [], "camera_model": "OPENCV"}', "camera poses"), (b'{"note": "made with Blender"}', "JSON")),
    *((b"[[1, 2], [3]]", "JSON"), (b"# settings\nlearning_rate: 0.1\n", "YAML")),
    *((b"<?xml version='1.0'?>\n<thing/>", "XML"), (b"# Blender\nnewmtl a\n", "materials"), (bytes(200), "zeros")),
]
NAMES = [
    *(("a.rcs", "ReCap"), ("A.FLS", "Faro"), ("a.zfs", "Zoller"), ("a.pod", "Pointools"), ("a.raw", "raw volume")),
    *(("out/octree.bin", "Potree"), ("a.svo2", "ZED"), ("a.scad", "OpenSCAD"), ("000.bin", "raw array")),
]


@pytest.mark.parametrize(("head", "named"), SHAPES)
def test_a_shape_in_another_format_is_named(head: bytes, named: str) -> None:
    assert sniff_format(head[:HEAD_BYTES]) is None
    reason, detail = explain_refusal(head)
    assert (reason, named in detail, "; " in detail) == ("FORMAT_NOT_SUPPORTED", True, True), detail


@pytest.mark.parametrize(("head", "named"), OTHERS)
def test_a_file_of_another_kind_is_named(head: bytes, named: str) -> None:
    assert sniff_format(head[:HEAD_BYTES]) is None
    reason, detail = explain_refusal(head)
    assert (reason, named in detail, "; " in detail) == ("FORMAT_NOT_RECOGNIZED", True, True), detail


READ = (
    *(b"ISO-10303-21;", b"PXR-USDC", b"<robot name='r'>", _zip("scene.usdc"), _zip("[Content_Types].xml")),
    b"\x83\xa8encoding\x85",
)
"""How files begin that are read: the table has them for names whose content is another."""


def test_each_row_of_the_table_is_tried_here() -> None:
    told = [refused(head) for head, _ in (*SHAPES, *OTHERS)]
    told += [refused(b"\x01\x02", name) for name, _ in NAMES]
    told += [refused(head) for head in READ]
    assert len(SHAPES) + len(OTHERS) > 139
    assert {row.told() for row in _rows()} == set(told)


@pytest.mark.parametrize(("name", "named"), NAMES)
def test_a_name_counts_where_the_bytes_tell_nothing(name: str, named: str) -> None:
    head = b"\x01\x02\x03\x04some program's own" + bytes(500)
    assert named in explain_refusal(head, name)[1]
    assert named not in explain_refusal(head)[1]
    assert "PNG" in explain_refusal(b"\x89PNG\r\n", name)[1]


def test_a_name_does_not_stand_for_the_content() -> None:
    head = b"\x01\x02\x03\x04some program's own" + bytes(500)
    reason, detail = explain_refusal(head, "part.STEP")
    assert reason == "FORMAT_NOT_RECOGNIZED"
    assert "by its name a STEP model of CAD, but its content is not" in detail
    assert explain_refusal(head, "part.step.unknown") == explain_refusal(head)


def test_a_text_that_names_another_program_is_not_that_programs_file() -> None:
    for text in (b"my notes on #usda and LASF files\n", b"# a <robot in a comment\n", b"said: never\nmore words\n"):
        assert explain_refusal(text)[0] == "FORMAT_NOT_RECOGNIZED"
    for text in (b"OFFICE hours", b"hello world\n3 apples\n", b"version 3\n", b"x" * 512, b"1 2\n3 4\n"):
        assert explain_refusal(text)[1].startswith(_GENERIC), text


def test_random_bytes_are_seldom_named() -> None:
    draw = np.random.default_rng(0)
    heads = [draw.bytes(HEAD_BYTES) for _ in range(300)]
    named = [head for head in heads if sniff_format(head) is None and not explain_refusal(head)[1].startswith(_GENERIC)]
    assert len(named) <= 3
