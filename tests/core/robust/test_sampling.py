"""What is sampled, what is set aside, and what the search starts from."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from regnf_core.errors import InvalidDetectionError, NoSurfaceError
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import CountingField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.model import Hull
from regnf_core.robust.scene import smooth, support_planes
from regnf_core.robust.search.bounds import super_fibonacci, turns_about
from regnf_core.robust.working_frame import Samples, sample_object_surface, sample_scene_surface
from tests.core.analytic import AnalyticField, chair, chair_pose, room, sphere
from tests.core.robust.shapes import detection, random_pose


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_object_samples_are_near_the_surface_even_and_cheap() -> None:
    field = CountingField(sphere(0.4, (0.3, -0.2, 0.1), [[-2.0] * 3, [2.0] * 3]))
    found = sample_object_surface(field, 2000, generator())
    back = found.frame.out_of(found.samples.on_surface())
    radius = (back - torch.tensor([0.3, -0.2, 0.1])).norm(dim=-1)
    assert len(found.samples) > 800
    assert (radius - 0.4).abs().max() < 2e-3
    assert found.frame.length == pytest.approx(0.8, rel=0.01)
    octants = (back - back.mean(0) > 0).long() @ torch.tensor([1, 2, 4])
    counts = torch.bincount(octants, minlength=8)
    assert counts.min() > 0.8 * counts.max()
    assert field.evaluations < 30_000


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_about_the_same_number_of_samples_at_any_scale(scale: float) -> None:
    plain = sample_object_surface(chair(), 5000, generator())
    other = sample_object_surface(TransformedField(chair(), random_pose(0, scale)), 5000, generator())
    # Cells that are halved are four times as many: the surface that all samples stand for is the same.
    other_area, area = (len(one.samples) * one.spacing**2 for one in (other, plain))
    assert 0.5 < other_area / area < 2.0


def test_a_cavity_within_matter_is_not_sampled() -> None:
    def shell(points: Tensor) -> Tensor:
        radius = points.norm(dim=-1)
        return torch.maximum(radius - 0.5, 0.3 - radius)

    found = sample_object_surface(AnalyticField(shell, [[-1.0] * 3, [1.0] * 3]), 4000, generator())
    radius = found.frame.out_of(found.samples.on_surface()).norm(dim=-1)
    assert radius.min() > 0.45


def test_floor_and_walls_are_told_from_the_chair_in_any_orientation() -> None:
    turn = random_pose(4, 1.0)
    old = detection()
    box = OrientedBox(turn.apply(old.center[None])[0], old.size, turn.rotation @ old.rotation)
    scene = TransformedField(room(chair_pose()), turn.inverse())
    found = sample_scene_surface(scene, box, 4000, generator())
    surface = turn.inverse().apply(found.frame.out_of(found.samples.on_surface()))
    on_chair = chair().signed_distance(chair_pose().apply(surface)).abs() < 0.02
    aside = support_planes(found.samples, generator())
    assert (aside & (surface[:, 2] < 0.005)).sum() == (surface[:, 2] < 0.005).sum() > 200
    assert (aside & on_chair & (surface[:, 2] > 0.03)).sum() == 0


def test_an_empty_box_and_a_box_elsewhere_are_refused() -> None:
    with pytest.raises(NoSurfaceError) as empty:
        sample_scene_surface(
            room(chair_pose()), OrientedBox.from_corners([-0.8, 0.3, 0.4], [-0.6, 0.5, 0.6]), 500, generator()
        )
    assert empty.value.reason == "NO_SURFACE_IN_DETECTION"
    with pytest.raises(InvalidDetectionError) as elsewhere:
        sample_scene_surface(room(chair_pose()), OrientedBox.from_corners([5, 5, 5], [6, 6, 6]), 500, generator())
    assert elsewhere.value.reason == "DETECTION_OUTSIDE_SCENE"


def test_rotations_are_proper_and_cover_all_of_them() -> None:
    R = super_fibonacci(600)
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double().expand(600, 3, 3))
    assert (torch.linalg.det(R) > 0).all()
    other = torch.stack([random_pose(k, 1.0).rotation for k in range(200)])
    trace = torch.einsum("aij,bij->ab", R, other)
    angle = ((trace.amax(0) - 1) / 2).clamp(-1, 1).acos()
    assert angle.max() < 0.61  # 35 degrees
    quarter = turns_about(torch.tensor([0.0, 0.0, 1.0]), 4)[1]
    expected = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(quarter, expected, atol=1e-12, rtol=0)


# Supports of rough surfaces, and how rough a surface is found to be: against made-up samples of known shape.


def sheet(count: int, z: float, normal: float, seed: int) -> Samples:
    """A unit square's points at a height, facing up or down."""
    points = torch.rand(count, 3, generator=generator(seed)) - 0.5
    points[:, 2] = z
    return Samples(points, torch.zeros(count), torch.tensor([0.0, 0.0, normal]).expand(count, 3))


def crate(count: int) -> Samples:
    """The four sides and the lid of a box that stands on z = 0."""
    draw = generator(7)
    sides = torch.randint(5, (count,), generator=draw)
    normals = torch.tensor([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0], [0, 0, 1.0]])[sides]
    points = torch.rand(count, 3, generator=draw) - 0.5
    points = torch.where(normals != 0, 0.5 * normals, points) * torch.tensor([0.4, 0.4, 0.5])
    return Samples(points + torch.tensor([0.0, 0.0, 0.25]), torch.zeros(count), normals)


def roughened(samples: Samples, height: float, tilt: float) -> Samples:
    """The samples moved along their normals and their normals tilted, by random amounts of these sizes."""
    draw = generator(3)
    shift = height * torch.randn(len(samples), 1, generator=draw)
    normals = normalize(samples.normals + tilt * torch.randn(len(samples), 3, generator=draw), dim=-1)
    return replace(samples, points=samples.points + shift * samples.normals, normals=normals)


def floor_with_crumbs() -> tuple[Samples, Tensor]:
    """A floor, scattered crumbs beneath it that face all ways, a crate; and which samples are the crate's."""
    sideways = normalize(torch.randn(100, 3, generator=generator(5)), dim=-1)
    crumbs = replace(sheet(100, -0.06, 1.0, 2), normals=sideways)
    rough = roughened(Samples.cat([sheet(900, 0.0, 1.0, 1), crumbs, crate(1000)]), 0.006, 0.35)
    return rough, torch.arange(2000) >= 1000


def test_a_rough_floor_with_crumbs_beneath_is_set_aside_and_the_crate_is_kept() -> None:
    samples, of_crate = floor_with_crumbs()
    aside = support_planes(samples, generator())
    assert aside[~of_crate].float().mean() > 0.95
    assert aside[of_crate & (samples.points[:, 2] > 0.06)].sum() == 0


def test_the_same_crumbs_beneath_an_accurate_plane_are_the_rest_of_an_object() -> None:
    draw = normalize(torch.randn(200, 3, generator=generator(5)), dim=-1)
    below = replace(sheet(200, -0.06, 1.0, 2), normals=draw.abs() * torch.tensor([1, 1, 0]))
    assert not support_planes(Samples.cat([sheet(900, 0.0, 1.0, 1), below]), generator()).any()


def test_a_crate_in_the_air_and_a_plane_that_ends_with_the_box_are_no_support() -> None:
    assert not support_planes(roughened(crate(1500), 0.006, 0.35), generator()).any()
    samples = sheet(500, 0.0, 1.0, 1)
    assert not support_planes(samples, generator(), outside=torch.zeros(500, dtype=torch.bool)).any()


@pytest.mark.parametrize("height", [0.0, 0.01])
def test_roughness_is_the_height_of_the_bumps(height: float) -> None:
    found = smooth(roughened(sheet(4000, 0.0, 1.0, 1), height, 0.0))
    assert found.roughness == pytest.approx(height, rel=0.15, abs=1e-6)
    assert found.normal_roughness == pytest.approx(0.0, abs=1e-6)
    assert found.points[:, 2].std() <= 0.5 * height + 1e-6


def test_normal_roughness_is_the_tilt_of_the_normals_and_thin_parts_keep_their_sides() -> None:
    both = roughened(Samples.cat([sheet(2000, 0.0, 1.0, 1), sheet(2000, -0.02, -1.0, 2)]), 0.0, 0.3)
    found = smooth(both)
    # Tilted by 0.3 along both tangents: 1 - cos of the median angle, 0.3 sqrt(2 ln 2) = 0.353 in the tangent, 0.059.
    assert found.normal_roughness == pytest.approx(0.059, abs=0.012)
    assert (found.normals[:2000, 2] > 0.9).float().mean() > 0.99
    assert (found.normals[2000:, 2] < -0.9).float().mean() > 0.99


def slab(height: float) -> Samples:
    """The lid of something that lies flat on z = 0, .6 long."""
    lid = sheet(600, height, 1.0, 4)
    return Samples(lid.points * torch.tensor([0.6, 0.6, 1.0]), lid.values, lid.normals)


@pytest.mark.parametrize("turned", [False, True])
def test_what_lies_flat_on_a_table_is_kept_where_the_box_is_as_flat(turned: bool) -> None:
    """A keyboard, .015 high, in a box of that height: thinner than what is removed of a table beneath a chair."""
    table = sheet(1200, 0.0, 1.0, 1)
    of_slab = torch.arange(1800) >= 1200
    samples = Samples.cat([table, slab(0.015)])
    beneath = ~of_slab & (samples.points[:, :2].abs() < 0.3).all(-1)
    samples, of_slab = samples[~beneath], of_slab[~beneath]
    edges = torch.diag(torch.tensor([0.7, 0.7, 0.025]))
    outside = (samples.points[:, :2].abs() > 0.35).any(-1)
    step = torch.tensor([0.7, -0.4, 1.1, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    R = Sim3.identity().perturb(step).rotation.float()
    if turned:
        samples = replace(samples, points=samples.points @ R.T, normals=samples.normals @ R.T)
        edges = edges @ R.T
    aside = support_planes(samples, generator(), edges, outside)
    assert bool(aside[~of_slab].all())
    assert not bool(aside[of_slab].any())
    higher = support_planes(samples, generator(), outside=outside)
    assert bool(higher[of_slab].all()), "in a higher box it would go with it"


def test_the_plane_is_where_it_goes_on_outside_of_the_box() -> None:
    """Most samples lie on the lid, but only the table reaches beyond the box."""
    table, lid = sheet(700, 0.0, 1.0, 1), slab(0.1)
    ring = (table.points[:, :2].abs() > 0.3).any(-1)
    samples = Samples.cat([table[ring], lid, lid])
    of_lid = torch.arange(len(samples)) >= int(ring.sum())
    assert int(of_lid.sum()) > 2 * int(ring.sum())
    outside = (samples.points[:, :2].abs() > 0.33).any(-1)
    aside = support_planes(samples, generator(), torch.diag(torch.tensor([0.66, 0.66, 0.12])), outside)
    assert bool(aside[~of_lid].all())
    assert not bool(aside[of_lid].any())


# Convex hulls of surfaces: a box by hand, and shapes that have none.


CORNERS = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3) * torch.tensor([1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("point", "margin", "within"),
    [
        ([0.5, 1.0, 1.5], 0.0, True),
        ([0.5, 1.0, 1.5], 0.49, True),
        ([0.5, 1.0, 1.5], 0.51, False),  # half a unit from the nearest faces
        ([0.5, 1.0, 2.95], 0.1, False),
        ([1.2, 1.0, 1.5], 0.0, False),
        ([1.2, 1.0, 1.5], -0.3, True),
    ],
)
def test_a_box(point: list[float], margin: float, within: bool) -> None:
    assert bool(Hull.of(CORNERS).contains(torch.tensor(point), margin)) is within


def test_nothing_is_within_a_flat_surface() -> None:
    flat = CORNERS * torch.tensor([1.0, 1.0, 0.0])
    assert not bool(Hull.of(flat).contains(flat.mean(0), -1.0))
