import numpy as np

from regnf_fit.images.observing import local_planes


def test_cosines_on_a_slanted_plane():
    camera = np.array([[50.0, 0.0, 20.0], [0.0, 50.0, 15.0], [0.0, 0.0, 1.0]])
    rows, columns = np.indices((30, 40)) + 0.5
    rays = np.stack([(columns - 20.0) / 50.0, (rows - 15.0) / 50.0, np.ones_like(rows)], axis=-1)
    normal = np.array([0.6, 0.0, 0.8])
    depth = 2.0 / (rays @ normal)
    expected = (rays @ normal) / np.linalg.norm(rays, axis=-1)
    found = local_planes(depth[None].astype(np.float32), camera[None]).cosines[0]
    inner = found[2:-2, 2:-2]
    assert (inner > 0.0).all()
    np.testing.assert_allclose(inner, expected[2:-2, 2:-2], atol=2e-3)


def test_no_cosine_without_depth():
    depth = np.zeros((1, 8, 8), np.float32)
    depth[0, 4, 4] = 1.0
    assert (local_planes(depth, np.eye(3)[None]).cosines == 0.0).all()


def test_the_noise_is_found_and_grows_with_the_depth():
    camera = np.array([[50.0, 0.0, 20.0], [0.0, 50.0, 15.0], [0.0, 0.0, 1.0]])
    rng = np.random.default_rng(0)
    exact = np.repeat(np.linspace(1.0, 3.0, 9), 2)[:, None, None] * np.ones((18, 30, 40))
    expected = 0.002 * exact**2
    noisy = (exact + expected * rng.normal(size=exact.shape)).astype(np.float32)
    found = local_planes(noisy, np.tile(camera, (18, 1, 1))).deviations
    np.testing.assert_allclose(np.median(found, axis=(1, 2))[1:-1], expected[1:-1, 0, 0], rtol=0.1)


def test_a_thin_post_keeps_its_own_plane():
    camera = np.array([[50.0, 0.0, 20.0], [0.0, 50.0, 15.0], [0.0, 0.0, 1.0]])
    depth = np.full((1, 30, 40), 3.0, np.float32)
    depth[0, :, 20:22] = 2.0
    cosines = local_planes(depth, camera[None]).cosines[0]
    rows, columns = np.indices((30, 40)) + 0.5
    facing = 1.0 / np.sqrt(1.0 + ((columns - 20.0) / 50.0) ** 2 + ((rows - 15.0) / 50.0) ** 2)
    np.testing.assert_allclose(cosines[1:-1, 20:22], facing[1:-1, 20:22], atol=1e-3)
    np.testing.assert_allclose(cosines[2:-2, 17:19], facing[2:-2, 17:19], atol=1e-3)
