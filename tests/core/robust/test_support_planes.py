"""Supports of rough surfaces, and how rough a surface is found to be: against made-up samples of known shape."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.scene import smooth, support_planes
from regnf_core.robust.working_frame import Samples


def together(*parts: Samples) -> Samples:
    return Samples.cat(parts)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


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
    rough = roughened(together(sheet(900, 0.0, 1.0, 1), crumbs, crate(1000)), 0.006, 0.35)
    return rough, torch.arange(2000) >= 1000


def test_a_rough_floor_with_crumbs_beneath_is_set_aside_and_the_crate_is_kept() -> None:
    samples, of_crate = floor_with_crumbs()
    aside = support_planes(samples, generator())
    assert aside[~of_crate].float().mean() > 0.95
    assert aside[of_crate & (samples.points[:, 2] > 0.06)].sum() == 0


def test_the_same_crumbs_beneath_an_accurate_plane_are_the_rest_of_an_object() -> None:
    draw = normalize(torch.randn(200, 3, generator=generator(5)), dim=-1)
    below = replace(sheet(200, -0.06, 1.0, 2), normals=draw.abs() * torch.tensor([1, 1, 0]))
    assert not support_planes(together(sheet(900, 0.0, 1.0, 1), below), generator()).any()


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
    both = roughened(together(sheet(2000, 0.0, 1.0, 1), sheet(2000, -0.02, -1.0, 2)), 0.0, 0.3)
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
    samples = together(table, slab(0.015))
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
    samples = together(table[ring], lid, lid)
    of_lid = torch.arange(len(samples)) >= int(ring.sum())
    assert int(of_lid.sum()) > 2 * int(ring.sum())
    outside = (samples.points[:, :2].abs() > 0.33).any(-1)
    aside = support_planes(samples, generator(), torch.diag(torch.tensor([0.66, 0.66, 0.12])), outside)
    assert bool(aside[~of_lid].all())
    assert not bool(aside[of_lid].any())
