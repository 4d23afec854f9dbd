import numpy as np

from regnf_core.reconstruction.depth_normals import ray_cosines


def test_cosines_on_a_slanted_plane():
    camera = np.array([[50.0, 0.0, 20.0], [0.0, 50.0, 15.0], [0.0, 0.0, 1.0]])
    rows, columns = np.indices((30, 40)) + 0.5
    rays = np.stack([(columns - 20.0) / 50.0, (rows - 15.0) / 50.0, np.ones_like(rows)], axis=-1)
    normal = np.array([0.6, 0.0, 0.8])
    depth = 2.0 / (rays @ normal)
    expected = (rays @ normal) / np.linalg.norm(rays, axis=-1)
    found = ray_cosines(depth[None].astype(np.float32), camera[None])[0]
    inner = found[2:-2, 2:-2]
    assert (inner > 0.0).all()
    np.testing.assert_allclose(inner, expected[2:-2, 2:-2], atol=2e-3)


def test_no_cosine_without_depth():
    depth = np.zeros((1, 8, 8), np.float32)
    depth[0, 4, 4] = 1.0
    assert (ray_cosines(depth, np.eye(3)[None]) == 0.0).all()
