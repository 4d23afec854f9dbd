"""nvblox's maps: SQLite files that nobody vouches for, and voxels whose values belong to their middles."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import open_field
from regnf_core.importing.containers import sqlite_source
from regnf_core.importing.containers.sqlite_source import TableSource
from regnf_core.importing.families import nvblox
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.gate import import_field
from regnf_core.importing.gate.report import ImportLimits
from tests.core.fields.grids import slow_trilinear
from tests.core.importing.archives import assert_refused, patched

SIZE, RADIUS, CUT = 0.05, 0.6, 0.2
CENTER = np.array([0.1, -0.2, 0.05])
TABLES = """
CREATE TABLE tsdf_layer_metadata (param_name TEXT PRIMARY KEY, value_string TEXT, value_int INT, value_float REAL);
CREATE TABLE tsdf_layer_data (index_x INT, index_y INT, index_z INT, data BLOB, UNIQUE (index_x, index_y, index_z));
CREATE TABLE color_layer_metadata (param_name TEXT PRIMARY KEY, value_string TEXT, value_int INT, value_float REAL);
CREATE TABLE color_layer_data (index_x INT, index_y INT, index_z INT, data BLOB);
"""


def true_distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(points - CENTER, axis=-1) - RADIUS)


def ball_blocks() -> list[tuple[int, int, int, bytes]]:
    """Rows of a map of a ball, cut off; what lies deep inside was never seen."""
    rows = []
    voxels = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), axis=-1)  # x slowest, as in the file
    for index in np.stack(np.meshgrid(*[np.arange(-3, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3):
        distance = true_distance(SIZE * (8 * index + voxels + 0.5))
        if (np.abs(distance) > SIZE).all():
            continue
        seen = distance > -CUT
        block = np.stack((np.where(seen, np.minimum(distance, CUT), 0.0), seen), axis=-1).astype("<f4")
        rows.append((*map(int, index), block.tobytes()))
    return rows


def write_map(path: Path, rows: list[Any] | None = None, more: str = "", block_size: Any = 8 * SIZE) -> Path:
    connection = sqlite3.connect(path)
    connection.executescript(TABLES + more)
    connection.execute("INSERT INTO tsdf_layer_metadata VALUES ('block_size', NULL, NULL, ?)", (block_size,))
    connection.execute("INSERT INTO tsdf_layer_metadata VALUES ('writer', 'a test', 3, NULL)")
    connection.executemany("INSERT INTO tsdf_layer_data VALUES (?, ?, ?, ?)", ball_blocks() if rows is None else rows)
    connection.commit()
    connection.close()
    return path


def converted(path: Path, overrides: dict[str, Any] | None = None) -> dict[str, Any]:
    return convert_file(path, path.parent, overrides, ImportLimits())


def test_a_map_of_a_ball_through_the_gate(tmp_path: Path) -> None:
    report = import_field(write_map(tmp_path / "map.nvblx"), tmp_path)
    assert report.family == "nvblox"
    assert report.warnings == ()
    assert report.plausibility["gradient_median"] == pytest.approx(1.0, abs=0.05)
    rng = np.random.default_rng(8)
    direction = rng.normal(size=(80, 3))
    reach = RADIUS + SIZE * rng.uniform(-1, 1, (80, 1))
    points = CENTER + reach * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    distance = open_field(tmp_path / FIELD_NAME).signed_distance(torch.from_numpy(points))
    expected = [
        slow_trilinear(lambda node: float(true_distance(SIZE * (np.array(node) + 0.5))), point / SIZE - 0.5)
        for point in points
    ]
    np.testing.assert_allclose(distance.numpy(), expected, rtol=0, atol=1e-5)


def test_axes_are_not_swapped(tmp_path: Path) -> None:
    """A floor: what changes from voxel to voxel is the height, the last axis."""
    block = np.zeros((8, 8, 8, 2), "<f4")
    block[..., 0], block[..., 1] = (np.arange(8) - 2.5) * SIZE, 1.0
    report = converted(write_map(tmp_path / "m", [(2, -1, 0, block.tobytes())]))
    np.testing.assert_allclose(report["bounds"], [[0.825, -0.375, 0.025], [1.175, -0.025, 0.375]], rtol=0, atol=1e-6)
    distance, gradient = open_field(tmp_path / FIELD_NAME).signed_distance_and_gradient(
        torch.tensor([[1.0, -0.2, 0.3]])
    )
    torch.testing.assert_close(distance, torch.tensor([0.15]), rtol=0, atol=1e-5)
    torch.testing.assert_close(gradient, torch.tensor([[0.0, 0.0, 1.0]]), rtol=0, atol=1e-5)


BLOCK = bytes(8**3 * 8)
SEEN = np.tile(np.array([0.1, 1.0], "<f4"), 512).tobytes()


@pytest.mark.parametrize(
    ("rows", "block_size", "reason"),
    [
        ([], 0.4, "TENSOR_SHAPE"),
        ([(0, 0, 0, BLOCK)], 0.4, "TENSOR_SHAPE"),
        ([(0, 0, 0, SEEN[:-8])], 0.4, "TENSOR_SHAPE"),
        ([(0, 0, 0, "text")], 0.4, "TENSOR_SHAPE"),
        ([(0, 0, 0, None)], 0.4, "TENSOR_SHAPE"),
        ([(0, 0, 0.5, SEEN)], 0.4, "TENSOR_SHAPE"),
        ([(1 << 40, 0, 0, SEEN)], 0.4, "TENSOR_SHAPE"),
        ([(0, 0, 0, SEEN), (1 << 25, 0, 0, SEEN)], 0.4, "FIELD_INDEX_INVALID"),
        ([(0, 0, 0, np.tile(np.array([np.nan, 1.0], "<f4"), 512).tobytes())], 0.4, "TENSOR_NOT_FINITE"),
        ([(0, 0, 0, SEEN)], 0.4, "NO_ZERO_LEVEL"),
        ([(0, 0, 0, bytes(2 << 20))], 0.4, "SQLITE_MALFORMED"),
        (None, None, "TENSOR_MISSING"),
        (None, "0.4", "TENSOR_MISSING"),
        (None, -0.4, "TENSOR_MISSING"),
    ],
)
def test_faulty_maps_are_refused(tmp_path: Path, rows: Any, block_size: Any, reason: str) -> None:
    untyped = "DROP TABLE tsdf_layer_metadata;"
    untyped += "CREATE TABLE tsdf_layer_metadata (param_name, value_string, value_int, value_float);"
    path = write_map(tmp_path / "m", rows, untyped if isinstance(block_size, str) else "", block_size)
    assert_refused(lambda: converted(path), reason)


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ("CREATE VIEW v AS SELECT 1;", "SQLITE_NOT_PLAIN"),
        ("DROP TABLE tsdf_layer_data; CREATE VIEW tsdf_layer_data AS SELECT 1 AS index_x;", "SQLITE_NOT_PLAIN"),
        ("CREATE TRIGGER t AFTER INSERT ON color_layer_data BEGIN SELECT 1; END;", "SQLITE_NOT_PLAIN"),
        ("CREATE VIRTUAL TABLE f USING fts5(body);", "SQLITE_NOT_PLAIN"),
        ("CREATE TABLE g (a INT, b INT GENERATED ALWAYS AS (a + 1));", "SQLITE_NOT_PLAIN"),
        ("ALTER TABLE tsdf_layer_data ADD COLUMN c AS (1 + 1);", "SQLITE_NOT_PLAIN"),
        ("CREATE TABLE g (a INT, b INT AS (a + 1) STORED);", "SQLITE_NOT_PLAIN"),
        ("CREATE TABLE g (a, b as(abs(a)));", "SQLITE_NOT_PLAIN"),
        ("CREATE TABLE g (a, 'b' AS (a)) WITHOUT ROWID;".replace("a,", "a PRIMARY KEY,"), "SQLITE_NOT_PLAIN"),
        ("CREATE INDEX i ON tsdf_layer_data (index_x + 1);", "SQLITE_NOT_PLAIN"),
        ("CREATE INDEX i ON tsdf_layer_data (index_x) WHERE index_x > 1;", "SQLITE_NOT_PLAIN"),
        (
            "PRAGMA writable_schema = ON; INSERT INTO sqlite_master VALUES"
            " ('index', 'v', 'tsdf_layer_data', 0, 'CREATE VIEW v AS SELECT 1');",
            "SQLITE_MALFORMED",
        ),
        ("".join(f"CREATE TABLE t{i} (a);" for i in range(70)), "SQLITE_NOT_PLAIN"),
        ("CREATE TABLE more_tsdf_data (a); CREATE TABLE more_tsdf_metadata (a);", "FAMILY_NOT_SUPPORTED"),
        (
            "DROP TABLE tsdf_layer_metadata; CREATE TABLE tsdf_layer_metadata (a, b, c, d);",
            "SQLITE_MALFORMED",
        ),
        ("DROP TABLE tsdf_layer_data; DROP TABLE tsdf_layer_metadata;", "FAMILY_NOT_SUPPORTED"),  # colors alone
        ("DROP TABLE tsdf_layer_data; DROP TABLE color_layer_data;", "FIELD_NOT_RECOGNIZED"),
    ],
)
def test_other_databases_are_refused(tmp_path: Path, more: str, reason: str) -> None:
    path = tmp_path / "m"
    connection = sqlite3.connect(path)
    connection.executescript(TABLES + more)
    connection.close()
    assert_refused(lambda: converted(path), reason)


def test_entries_that_mean_nothing_are_refused(tmp_path: Path) -> None:
    path = write_map(tmp_path / "m")
    assert_refused(lambda: converted(path, {"truncation": 0.1}), "INVALID_DESCRIPTION")
    assert_refused(lambda: converted(path, {"family": "neus"}), "FAMILY_NOT_SUPPORTED")


def test_rows_bytes_and_work_are_capped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = memoryview(write_map(tmp_path / "m").read_bytes())
    monkeypatch.setattr(nvblox, "_MAX_BLOCKS", 5)
    assert_refused(lambda: converted(tmp_path / "m"), "TENSOR_TOO_LARGE")
    monkeypatch.setattr(nvblox, "_MAX_BLOCKS", 1 << 20)
    assert_refused(
        lambda: convert_file(tmp_path / "m", tmp_path, None, ImportLimits(tensor_bytes=8192)), "TENSOR_TOO_LARGE"
    )
    monkeypatch.setattr(sqlite_source, "_WORK_STEP", 10)
    monkeypatch.setattr(sqlite_source, "_MAX_WORK_STEPS", 20)
    assert_refused(lambda: list(TableSource(data).rows("tsdf_layer_data", ("data",), 1000)), "SQLITE_MALFORMED")
    monkeypatch.setattr(sqlite_source, "MAX_DATABASE_BYTES", 1000)
    assert_refused(lambda: TableSource(data), "TENSOR_TOO_LARGE")


def test_nothing_but_reading_is_allowed(tmp_path: Path) -> None:
    source = TableSource(memoryview(write_map(tmp_path / "m").read_bytes()))
    for statement in (
        "DELETE FROM tsdf_layer_data",
        "CREATE TABLE x (a)",
        f"ATTACH DATABASE '{tmp_path}/other' AS other",
        "SELECT load_extension('x')",
        "SELECT randomblob(10)",
        "PRAGMA journal_mode = WAL",
        "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x FROM c",
    ):
        with pytest.raises(sqlite3.Error):
            source._connection.execute(statement).fetchall()
    assert_refused(lambda: list(source.rows("sqlite_master", ("sql",), 9)), "TENSOR_MISSING")
    assert_refused(lambda: list(source.rows("tsdf_layer_data", ("data FROM x; --",), 9)), "TENSOR_MISSING")
    source.close()


def test_a_damaged_header_and_a_file_cut_short_are_refused(tmp_path: Path) -> None:
    data = write_map(tmp_path / "m").read_bytes()
    page = int.from_bytes(data[16:18], "big")
    for faulty, reason in (
        (data[:50], "FILE_TRUNCATED"),
        (data[:-1], "FILE_TRUNCATED"),
        (data[:-page], "FILE_TRUNCATED"),
        (patched(data, 16, b"\x03\x01"), "SQLITE_MALFORMED"),
        (patched(data, 18, b"\x02\x02"), "SQLITE_MALFORMED"),
        (patched(data, 0, b"sQLite"), "SQLITE_MALFORMED"),
        (data[:100] + bytes(len(data) - 100), "SQLITE_MALFORMED"),
    ):
        assert_refused(lambda faulty=faulty: TableSource(memoryview(faulty)), reason)


def test_damage_anywhere_is_refused_or_does_no_harm(tmp_path: Path) -> None:
    data = write_map(tmp_path / "m", ball_blocks()[:8]).read_bytes()
    random = Random(5)
    refused = 0
    for _ in range(150):
        damaged = bytearray(data)
        for _ in range(random.randint(1, 8)):
            damaged[random.randrange(16, len(data) if random.random() < 0.3 else 4096)] = random.randrange(256)
        try:
            nvblox.convert_database(TableSource(memoryview(damaged)), 1 << 24, nvblox.UploadDescription())
        except FieldFormatError:
            refused += 1
    assert 10 < refused < 150


def test_a_map_far_from_the_origin_is_the_same_map(tmp_path: Path) -> None:
    blocks = np.array([1_250_000, -9_000_001, 300])
    far_rows = [(*(int(i) for i in blocks + row[:3]), row[3]) for row in ball_blocks()]
    fields = []
    for name, rows in (("near", ball_blocks()), ("far", far_rows)):
        (tmp_path / name).mkdir()
        convert_file(write_map(tmp_path / name / "map.nvblx", rows), tmp_path / name, None, ImportLimits())
        fields.append(open_field(tmp_path / name / FIELD_NAME))
    near, far = fields
    shift = torch.from_numpy(blocks * (8 * SIZE))
    points = torch.from_numpy(CENTER + np.random.default_rng(0).uniform(-RADIUS, RADIUS, (500, 3)))
    torch.testing.assert_close(far.signed_distance(points + shift), near.signed_distance(points), atol=1e-6, rtol=0.0)
    torch.testing.assert_close(far.bounds, near.bounds + shift, atol=1e-6, rtol=0.0)


def test_a_map_of_the_published_schema_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As nvblox's serializer creates its tables, and as it writes numbers: in quotes."""
    columns = "param_name TEXT PRIMARY KEY UNIQUE NOT NULL,value_string TEXT,value_int INT,value_float FLOAT"
    index = "index_x, index_y, index_z"
    blocks = f"{index.replace(',', ' INT NOT NULL,')} INT NOT NULL,data BLOB,PRIMARY KEY({index})"
    published = f"CREATE TABLE tsdf_layer_metadata({columns});CREATE TABLE tsdf_layer_data({blocks});"
    found = []
    for name, tables, size in (("ours", TABLES, 8 * SIZE), ("published", published, f"{8 * SIZE:.6f}")):
        monkeypatch.setattr("tests.core.importing.test_nvblox.TABLES", tables)
        data = write_map(tmp_path / name, block_size=size).read_bytes()
        found.append(nvblox.convert_database(TableSource(memoryview(data)), 1 << 24, nvblox.UploadDescription()))
    assert found[0].description == found[1].description
    np.testing.assert_array_equal(found[0].tensors["values"], found[1].tensors["values"])


@pytest.mark.parametrize(
    ("tables", "named"),
    [
        (("Node", "Link", "Data", "Word"), "rtabmap-export"),
        (("topics", "messages", "metadata"), "POST /recordings"),
        (("cameras", "images", "keypoints", "matches"), "COLMAP"),
    ],
)
def test_databases_of_other_programs_are_named(tmp_path: Path, tables: tuple[str, ...], named: str) -> None:
    connection = sqlite3.connect(tmp_path / "m")
    for table in tables:
        connection.execute(f"CREATE TABLE {table} (id INTEGER NOT NULL, pose BLOB, PRIMARY KEY (id))")
    connection.execute(f"CREATE TRIGGER added BEFORE INSERT ON {tables[0]} WHEN new.id < 0 BEGIN SELECT 1; END")
    connection.commit()
    connection.close()
    data = (tmp_path / "m").read_bytes()
    with pytest.raises(FieldFormatError, match=named) as caught:
        TableSource(memoryview(data))
    assert caught.value.reason == "FAMILY_NOT_SUPPORTED"
