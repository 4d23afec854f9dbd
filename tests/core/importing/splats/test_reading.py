"""Files of Gaussian splats by other programs' writers against the splats that they were given."""

from __future__ import annotations

import gzip
import shutil
import struct
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.sniff import HEAD_BYTES, sniff_format, splat_format
from regnf_core.importing.families.gaussian_splats import read_splats
from regnf_core.importing.splats.gaussians import Doubles, Splats, basis, sound, turned_harmonics, write_ply
from regnf_core.moved_splats import pose_in, read_splat_file, write_moved

DATA = Path(__file__).parent / "data"
TURNED_X, TURNED_Z = np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])


def read(name: str) -> Splats:
    return read_splat_file(DATA / name)


def covariances(splats: Splats) -> Doubles:
    factors = splats.axes() * np.exp(splats.scales)[:, None, :]
    return (factors @ factors.transpose(0, 2, 1)).astype(np.float64)


def in_order_of(splats: Splats, means: Doubles) -> Splats:
    """Writers may change the order."""
    apart = np.linalg.norm(splats.means[None] - means[:, None], axis=2)
    return splats.chosen(apart.argmin(axis=1))


@pytest.mark.parametrize(
    ("name", "frame", "terms", "place", "shape", "color", "rest"),
    [
        ("splats.compressed.ply", np.eye(4), 16, 0.01, 0.01, 0.01, 0.02),
        ("splats.splat", np.eye(4), 1, 1e-6, 0.03, 0.01, 0.0),
        ("splats_0_1.ksplat", np.eye(4), 4, 1e-6, 1e-5, 0.02, 1e-6),
        ("splats_1_2.ksplat", np.eye(4), 9, 1e-3, 0.005, 0.02, 0.001),
        ("splats_2_2.ksplat", np.eye(4), 9, 1e-3, 0.005, 0.02, 0.01),
        ("splats.sog", np.eye(4), 16, 0.001, 0.04, 0.02, 0.02),
        ("splats.spz", TURNED_X, 16, 0.001, 0.08, 0.02, 0.1),
        ("splats-3.spz", TURNED_X, 16, 0.001, 0.08, 0.02, 0.1),
        ("splats.glb", TURNED_Z, 16, 1e-6, 1e-5, 1e-6, 1e-6),
    ],
)
def test_the_splats_that_another_program_was_given(
    name: str, frame: Doubles, terms: int, place: float, shape: float, color: float, rest: float
) -> None:
    """In the writer's frame: places, shapes, opacities and harmonics, to the format's own digits."""
    given = read("splats.ply")
    found = in_order_of(read(name).moved(frame), given.means)
    assert len(found) == len(given) == 64
    assert found.harmonics.shape == (64, terms, 3)
    np.testing.assert_allclose(found.means, given.means, atol=place)
    off = np.linalg.norm(covariances(found) - covariances(given), axis=(1, 2))
    assert (off / np.linalg.norm(covariances(given), axis=(1, 2))).max() < shape
    np.testing.assert_allclose(found.opacities, given.opacities, atol=0.005)
    np.testing.assert_allclose(found.harmonics[:, 0], given.harmonics[:, 0], atol=color)
    if terms > 1:
        assert np.abs(found.harmonics[:, 1:] - given.harmonics[:, 1:terms]).max() < rest


def test_the_trainers_file_by_hand() -> None:
    """One Gaussian of known numbers: logit and logarithm undone, w first, all of R before G."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{number}" for number in range(9)), "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    row = np.array([1, 2, 3, 0.1, 0.2, 0.3, *range(1, 10), 0.0, np.log(0.5), np.log(0.25), 0.0, 2, 0, 0, 0], "<f4")
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    found = sound(read_splats("splat-ply", memoryview(header.encode() + row.tobytes()), {}))[0]
    assert found.means.tolist() == [[1.0, 2.0, 3.0]]
    np.testing.assert_allclose(np.exp(found.scales), [[0.5, 0.25, 1.0]])
    assert found.rotations.tolist() == [[1.0, 0.0, 0.0, 0.0]]
    assert found.opacities.tolist() == [0.5]
    np.testing.assert_allclose(found.harmonics[0], [[0.1, 0.2, 0.3], [1, 4, 7], [2, 5, 8], [3, 6, 9]], rtol=1e-6)


def test_two_scales_are_surfels() -> None:
    given = read("splats.ply")
    flat = Splats(given.means, given.scales, given.rotations, given.opacities, given.harmonics, flat=True)
    found = read_splats("splat-ply", memoryview(write_ply(flat)), {})
    assert found.flat
    assert (np.exp(found.scales[:, 2]) < 1e-8).all()


def test_spz_of_version_2_by_hand() -> None:
    """Quaternions of three bytes, w rebuilt; places in 24 bits, the lowest first, also below zero."""
    turn = np.array([0.5, -0.5, 0.5])
    body = b"".join((int(4096 * value) & 0xFFFFFF).to_bytes(3, "little") for value in (1.5, -2.25, 0.0))
    body += bytes([51, 128, 128, 128, 160, 144, 176]) + np.round((turn + 1.0) * 127.5).astype(np.uint8).tobytes()
    head = struct.pack("<4sIIBBBB", b"NGSP", 2, 1, 0, 12, 0, 0)
    found = read_splats("spz", memoryview(gzip.compress(head + body)), {})
    assert found.means.tolist() == [[1.5, -2.25, 0.0]]
    np.testing.assert_allclose(found.opacities, [0.2])
    np.testing.assert_allclose(found.scales, [[0.0, -1.0, 1.0]])
    np.testing.assert_allclose(found.rotations, [[0.5, 0.5, -0.5, 0.5]], atol=0.01)


@pytest.mark.parametrize("name", sorted(path.name for path in DATA.iterdir() if path.name != "README.md"))
def test_each_file_is_told_by_its_bytes(name: str) -> None:
    data = (DATA / name).read_bytes()
    kind = "zip" if name.endswith(".sog") else splat_format(data)
    assert sniff_format(data[:HEAD_BYTES]) == kind
    assert kind == {"ply": "splat-ply", "sog": "zip"}.get(name.rpartition(".")[2], name.rpartition(".")[2])


@pytest.mark.parametrize("name", sorted(path.name for path in DATA.iterdir() if path.suffix not in (".md", ".splat")))
def test_a_file_cut_short_is_refused(name: str, tmp_path: Path) -> None:
    data = (DATA / name).read_bytes()
    for share in (0.3, 0.6, 0.95):
        (tmp_path / name).write_bytes(data[: int(share * len(data))])
        with pytest.raises(FieldFormatError) as caught:
            read_splat_file(tmp_path / name)
        assert caught.value.reason in {
            *("MESH_INVALID", "FORMAT_NOT_RECOGNIZED", "FILE_TRUNCATED", "ARCHIVE_MALFORMED", "FORMAT_NOT_SUPPORTED")
        }


@pytest.mark.parametrize("name", sorted(path.name for path in DATA.iterdir() if path.suffix not in (".md", ".sog")))
def test_a_damaged_file_is_read_or_refused(name: str, tmp_path: Path) -> None:
    data, random = (DATA / name).read_bytes(), np.random.default_rng(3)
    for _ in range(60):
        changed = bytearray(data)
        for at in random.integers(0, min(len(data), 8000), size=4):
            changed[at] = int(random.integers(256))
        (tmp_path / name).write_bytes(bytes(changed))
        with suppress(FieldFormatError):  # any other error fails
            assert np.isfinite(read_splat_file(tmp_path / name).means).all()


def test_sog_as_a_folder_in_an_archive(tmp_path: Path) -> None:
    with zipfile.ZipFile(DATA / "splats.sog") as archive:
        archive.extractall(tmp_path / "scene")
    packed = shutil.make_archive(str(tmp_path / "scene"), "zip", tmp_path, "scene")
    np.testing.assert_array_equal(read_splat_file(packed).means, read("splats.sog").means)
    with pytest.raises(FieldFormatError) as caught:
        read_splat_file(tmp_path / "scene" / "meta.json")
    assert caught.value.reason == "MESH_EXTERNAL_REFERENCE"


def test_harmonics_turn_with_the_splats() -> None:
    """The color seen in a direction is that seen before in the direction turned back."""
    random = np.random.default_rng(0)
    harmonics = random.normal(size=(5, 16, 3)).astype(np.float32)
    turn = Rotation.random(rng=random).as_matrix()
    directions = random.normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = np.einsum("dk,nkc->ndc", basis(directions @ turn, 16), harmonics)
    after = np.einsum("dk,nkc->ndc", basis(directions, 16), turned_harmonics(harmonics, turn))
    np.testing.assert_allclose(after, before, atol=2e-5)


def test_a_similarity_moves_places_shapes_and_sizes() -> None:
    splats = read("splats.ply")
    turn = Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix()
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = 2.5 * turn, [1.0, -2.0, 3.0]
    moved = splats.moved(T)
    np.testing.assert_allclose(moved.means, splats.means @ (2.5 * turn).T + T[:3, 3])
    expected = 2.5**2 * turn @ covariances(splats) @ turn.T
    np.testing.assert_allclose(covariances(moved), expected, atol=1e-5)


def test_moved_and_moved_back(tmp_path: Path) -> None:
    pose, there, back = tmp_path / "pose.json", tmp_path / "there.ply", tmp_path / "back.ply"
    pose.write_text('{"T_object_scene": {"matrix": [[0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]]}}')
    assert write_moved(DATA / "splats.sog", there, pose_in(pose, inverse=False)) == 64
    write_moved(there, back, pose_in(pose, inverse=True))
    np.testing.assert_allclose(read_splat_file(back).means, read("splats.sog").means, atol=1e-5)
    given = read("splats.sog").means[0]
    np.testing.assert_allclose(
        read_splat_file(there).means[0], [1 - 2 * given[1], 2 + 2 * given[0], 3 + 2 * given[2]], atol=1e-5
    )
