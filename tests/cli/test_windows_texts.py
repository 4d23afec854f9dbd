"""Texts as programs of Windows save them: marks, UTF-16, Windows-1252, ends of lines, tables of a German Excel."""

# ruff: noqa: E501 -- a table is one line of a table

from __future__ import annotations

import codecs
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from regnf_cli.batch_file import read_pairs
from regnf_cli.options import description, read_detection, read_options, read_transform
from regnf_cli.render import _edits
from regnf_core.errors import FieldFormatError, InvalidInputError
from regnf_core.importing.observing.reading import read_lines, read_matrices
from regnf_core.importing.run.opened import SettingsFile
from regnf_core.importing.settings.documents import read_documents
from regnf_core.texts import TextError, decode_text
from regnf_state.redis.client import redis_address
from regnf_state.settings import Settings, read_settings
from tests.cli.conftest import DATA, Run

ENCODINGS = {
    "UTF-8": "utf-8",
    "UTF-8 with its mark": "utf-8-sig",
    "UTF-16 of PowerShell": "utf-16",
    "UTF-16, high bytes first": lambda text: codecs.BOM_UTF16_BE + text.encode("utf-16-be"),
    "UTF-16 without a mark": "utf-16-le",
    "UTF-32": "utf-32",
    "Windows-1252": "cp1252",
    "ends of lines of Windows": lambda text: text.replace("\n", "\r\n").encode(),
    "ends of lines of an old Mac": lambda text: text.replace("\n", "\r").encode(),
    "two files joined": lambda text: text.encode("utf-8-sig"),
}
Encode = Callable[[str], bytes]
BOX = '{\n "label": "Stühle",\n "min": [0, 0, 0],\n "max": [1, 1, 1]\n}\n'
TRANSFORM = '{"made by": "Jürgen",\n "T_object_scene": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}\n'


@pytest.fixture(params=ENCODINGS.values(), ids=list(ENCODINGS))
def encode(request: pytest.FixtureRequest) -> Encode:
    how = request.param
    return how if callable(how) else lambda text: text.encode(how)


def test_files_of_the_command_line(encode: Encode, tmp_path: Path) -> None:
    def saved(text: str, name: str = "text.json") -> Path:
        path = tmp_path / name
        path.write_bytes(encode(text))
        return path

    assert read_detection(saved('{"center": [0, 0, 0],\n"size": [1, 1, 1]}\n')).size == (1, 1, 1)
    assert read_options(saved('{"up_axis": "z",\n"preset": "robust"}'), None)["up_axis"] == "z"
    assert read_transform(saved(TRANSFORM), "truth")[3] == [0, 0, 0, 1]
    assert description(str(saved('{"label": "Stühle",\n"up_axis": "z"}'))) == {"label": "Stühle", "up_axis": "z"}
    (tmp_path / "result.json").write_bytes(encode(TRANSFORM))
    edits = _edits(saved('[\n{"object": "Stühle.ply", "T_object_scene": "result.json"}]\n', "edits.json"))
    assert edits[0]["object"] == str(tmp_path / "Stühle.ply")
    assert edits[0]["T_object_scene"][0] == [1, 0, 0, 0]


def test_lists_of_pairs(encode: Encode, tmp_path: Path) -> None:
    (tmp_path / "Stühle.json").write_bytes(encode('{"min": [0, 0, 0], "max": [1, 1, 1]}'))
    table, lines = tmp_path / "pairs.csv", tmp_path / "pairs.jsonl"
    table.write_bytes(encode("key,scene,object,detection\nä,Räume/1.ply,b.ply,Stühle.json\n"))
    line = {"key": "ä", "scene": "Räume/1.ply", "object": "b.ply", "detection": "Stühle.json"}
    lines.write_bytes(encode(json.dumps(line, ensure_ascii=False) + "\n" + json.dumps(line, ensure_ascii=False)))
    for pairs in (list(read_pairs(table)), list(read_pairs(lines))):
        assert [pair.error for pair in pairs] == [None] * len(pairs)
        assert (pairs[0].key, pairs[0].scene) == ("ä", str(tmp_path / "Räume/1.ply"))
        assert (pairs[0].request or {})["detection"]["size"] == [1, 1, 1]


def test_settings_and_poses(encode: Encode) -> None:
    texts = {
        "config.yml": "# Größe\nwidth: 64\n",
        "a.json": '{"größe": 1,\n "width": 64}',
        "b.conf": "# Größe\nwidth = 64\n",
        "config": '{"ü": 1,\n "width": 64}',
    }
    files = tuple(SettingsFile(name, memoryview(encode(text))) for name, text in texts.items())
    assert [keys.find("width") for keys in read_documents(files).keys] == [64, 64, 64, 64]
    poses = read_lines("groundtruth.txt", encode("# Größe\n0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1\n"))
    assert poses is not None
    assert poses[:, :3, 3].tolist() == [[1, 2, 3], [1, 2, 3]]


@pytest.mark.parametrize("separator", [";", "\t", "; ", ";\t"])
@pytest.mark.parametrize("end", ["", ";", "\t"])
def test_poses_with_decimal_commas(separator: str, end: str) -> None:
    line = separator.join(["1,25", "1,5", "-2,5", "3", "0", "0", "0", "1,0"]) + end
    poses = read_lines("poses.csv", line.encode())
    assert poses is not None
    assert poses[0, :3, 3].tolist() == [1.5, -2.5, 3]
    found, _ = read_matrices([("0.txt", b"1, 0, 0, 4;\n0, 1, 0, 5;\n0, 0, 1, 6;\n")])
    assert found is not None
    assert np.array_equal(found[0, :3, 3], [4, 5, 6])


def test_files_of_tokens_and_passwords(encode: Encode, tmp_path: Path) -> None:
    file, password = tmp_path / "tokens", tmp_path / "password"
    file.write_bytes(encode("# für alle\nrobot:0123456789abcdef\nother:fedcba9876543210\n"))
    assert sorted(read_settings(api_tokens=f"@{file}").api_tokens) == [
        "other:fedcba9876543210",
        "robot:0123456789abcdef",
    ]
    password.write_bytes(encode("geheim\n"))
    settings = Settings(redis_url="redis://host:6379/0", redis_password=f"@{password}")
    assert redis_address(settings) == "redis://:geheim@host:6379/0"


def test_texts_that_the_shell_passes_on(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """`$(cat FILE)` keeps the mark and the carriage return; so do files of variables for Docker and systemd."""
    assert description('\ufeff{"up_axis": "z"}\r') == {"up_axis": "z"}
    monkeypatch.setenv("REGNF_REDIS_URL", "\ufeffredis://127.0.0.1:6379/0\r")
    monkeypatch.setenv("REGNF_PORT", "8081\r")
    monkeypatch.setenv("REGNF_STATE_DIR", f"{tmp_path}\r")
    monkeypatch.setenv("REGNF_API_TOKENS", '["robot:0123456789abcdef"]\r')
    settings = Settings()
    assert settings.redis_url == "redis://127.0.0.1:6379/0"
    assert (settings.port, settings.state_dir) == (8081, tmp_path)
    assert settings.api_tokens == {"robot:0123456789abcdef"}


TABLES = {
    "a German Excel": "key;scene;object;detection;pictures;seed\n1;r.ply;o.ply;box.json;WAHR;3\n",
    "an English Excel": "key,scene,object,detection,pictures,seed\n1,r.ply,o.ply,box.json,TRUE,3\n",
    "tabs": "key\tscene\tobject\tdetection\tpictures\tseed\n1\tr.ply\to.ply\tbox.json\ttrue\t3\n",
    "Excel's line with the separator": "sep=;\nkey;scene;object;detection;pictures;seed\n1;r.ply;o.ply;box.json;true;3\n",
    "quoted": '"key";"scene";"object";"detection";"pictures";"seed"\n"1";"r.ply";"o.ply";"box.json";"TRUE";"3"\n',
    "blanks": "key, scene, object, detection, pictures, seed\n1, r.ply, o.ply, box.json, true, 3 \n",
    "separators behind, empty rows": "key;scene;object;detection;pictures;seed;;\n;;;;;;;\n1;r.ply;o.ply;box.json;true;3;;\n\n;;\n",
    "whole numbers as others": "key,scene,object,detection,pictures,seed\n1,r.ply,o.ply,box.json,True,3.0\n",
    "with decimal commas": 'key;scene;object;detection;pictures;seed\n1;r.ply;o.ply;box.json;true;"3,00"\n',
    "a box in a cell": 'key,scene,object,detection,pictures,seed\n1,r.ply,o.ply,"{""min"": [0,0,0], ""max"": [1,1,1]}",true,3\n',
    "a quoted separator": '"sep=;"\nkey;scene;object;detection;pictures;seed\n1;r.ply;o.ply;box.json;true;3\n',
    "marks nobody sees": "key,scene,object,detection\u200b,pictures,seed\n1,r.ply,o.ply,box.json,true,3\n\x1a",
    "empty lines before": "\n\nkey,scene,object,detection,pictures,seed\n1,r.ply,o.ply,box.json,true,3\n",
}  # fmt: skip


@pytest.mark.parametrize("ending", [".csv", ".txt", ".tsv"])
@pytest.mark.parametrize("text", TABLES.values(), ids=list(TABLES))
def test_tables(text: str, ending: str, tmp_path: Path) -> None:
    (tmp_path / "box.json").write_text('{"min": [0, 0, 0], "max": [1, 1, 1]}')
    path = tmp_path / f"pairs{ending}"
    path.write_text(text)
    (pair,) = read_pairs(path)
    assert (pair.error, pair.key, pair.scene) == (None, "1", str(tmp_path / "r.ply"))
    assert (pair.objects, pair.request is not None) == ((str(tmp_path / "o.ply"),), True)
    request = pair.request or {}
    assert (request["seed"], request["pictures"], request["detection"]["size"]) == (3, True, [1, 1, 1])


HEADERS = {
    "misspelled": ("scen,object,detection\n", "unknown member `scen`", "Did you mean `scene`"),
    "without a column": ("scene,object\n", "`detection` is missing", "Write the column names"),
    "none at all": ("room.ply,chair.ply,box.json\n", "unknown member `room.ply`", "Write the column names"),
    "twice": ("scene,object,detection,scene\n", "twice", "Write the column names"),
    "empty": ("key\n", "`scene` is missing", "Write the column names"),
    "a workbook": ("PK\x03\x04\x14\x00\x06\x00", "it has control characters", ""),
    "no text": (
        "scene,object,detection\na\x81b",
        "not a text in UTF-8 from byte 25 (0x81) on, and not in Windows-1252",
        "",
    ),
}


@pytest.mark.parametrize(("header", "said", "hint"), HEADERS.values(), ids=list(HEADERS))
def test_a_wrong_header_is_one_error(run: Run, header: str, said: str, hint: str, tmp_path: Path) -> None:
    path = tmp_path / "pairs.csv"
    path.write_text(header + "a,b,c\n" * 50, encoding="latin-1")
    outcome = run("batch", path)
    reason = "INVALID_REQUEST" if hint else "TEXT_UNREADABLE"
    assert (outcome.code, outcome.stderr.count(reason)) == (2, 1)
    assert said in outcome.stderr
    assert hint in outcome.stderr
    assert [one.name for one in tmp_path.iterdir()] == ["pairs.csv"], "nothing has begun"


def test_failed_rows_are_shown(run: Run, tmp_path: Path) -> None:
    shutil.copy(DATA / "detection.json", tmp_path / "box.json")
    rows = ["room.ply,chair.ply,box.json"] * 9 + ["room.ply,chair.ply,nothing.json", "room.ply,chair.ply,box.json,5"]
    path = tmp_path / "pairs.csv"
    path.write_text("\n".join(["scene,object,detection", *rows]))
    outcome = run("batch", path, "--processes", 1, code=1)
    assert "11 failed" in outcome.stdout
    told = " ".join(outcome.stderr.split())
    assert "FILE_NOT_FOUND 10 pairs, lines 2, 3, 4, 5, 6 and 5 more; the first:" in told
    assert "room.ply: no such file" in told
    assert "INVALID_REQUEST line 12: the row has 4 cells, the header 3" in told


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (
            b"\x80\x01\x00\x00\x00\x00\x00\x00{",
            "not a text in UTF-8 from byte 1 (0x80) on, and it has control characters",
        ),
        ("ä".encode() + b"\xff", "not a text in UTF-8, from byte 3 (0xff) on"),
        (b"\xef\xbb\xbfab\xff", "not a text in UTF-8, from byte 6 (0xff) on"),
        (b"\xff\xfea\x00b", "not a text in UTF-16-LE, from byte 5 (0x62) on"),
        (b"{\x00\x01\x00", "not a text in UTF-8 or UTF-16-LE: it has the control character 0x01"),
    ],
)
def test_what_is_no_text_says_what_was_tried(data: bytes, said: str) -> None:
    with pytest.raises(TextError) as caught:
        decode_text(data)
    assert str(caught.value) == said


def test_every_reader_says_which_byte_it_was(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"robot:\x81")
    said = r"not a text in UTF-8 from byte 7 \(0x81\) on, and not in Windows-1252"
    for kind, read in (
        (InvalidInputError, lambda: read_detection(file)),
        (FieldFormatError, lambda: read_documents((SettingsFile("a.yml", memoryview(file.read_bytes())),))),
        (FieldFormatError, lambda: read_lines("poses.txt", file.read_bytes())),
        (InvalidInputError, lambda: read_settings(api_tokens=f"@{file}")),
    ):
        with pytest.raises(kind, match=said):
            read()
