"""A scene observed from one side: its occlusion boundary is found, and unobserved places weigh little."""

from __future__ import annotations

import torch
from torch.nn.functional import normalize

from regnf_core.robust.scene import occlusion_boundary
from regnf_core.robust.working_frame import Samples


def test_edge_on_surface_is_told_from_surface_that_faces_the_viewpoint() -> None:
    generator = torch.Generator().manual_seed(0)
    viewpoint = torch.tensor([1.5, -0.4, 0.8])
    edges = torch.rand(300, 3, generator=generator) - 0.5
    across = normalize(torch.linalg.cross(viewpoint - edges, torch.randn(300, 3, generator=generator)), dim=-1)
    points = torch.rand(400, 3, generator=generator) - 0.5
    sight = normalize(viewpoint - points, dim=-1)
    normals = normalize(sight + 0.4 * torch.randn(400, 3, generator=generator), dim=-1)
    facing = (normals * sight).sum(-1) > 0.2
    places, along = torch.cat([edges, points[facing]]), torch.cat([across, normals[facing]])
    found = occlusion_boundary(Samples(places, torch.zeros(len(places)), along), generator)[0]
    assert found[:300].float().mean() > 0.98
    assert found[300:].float().mean() < 0.02


def test_what_was_observed_from_all_sides_has_no_occlusion_boundary() -> None:
    generator = torch.Generator().manual_seed(0)
    normals = normalize(torch.randn(800, 3, generator=generator), dim=-1)
    assert not occlusion_boundary(Samples(0.4 * normals, torch.zeros(800), normals), generator)[0].any()
