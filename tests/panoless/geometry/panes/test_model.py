"""Panes over a plane: where rays meet them, what a camera sees, and what is written and read again."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.rays import pixel_rays
from panoless.geometry.panes.kind import PanesMirror
from panoless.geometry.panes.model import Panes, flat_panes
from panoless.geometry.plane.model import plane_buffers
from tests.support.mirror_panes import grid_of
from tests.support.mirror_plane import NORMAL, RECTANGLE, arc, plane_of

PLANE = grid_of(plane_of(RECTANGLE), 3, 2)


def bent(degree: int = 2) -> Panes:
    """Random polynomials over 3 × 2 panes."""
    flat = flat_panes(PLANE, degree)
    return replace(flat, coefficients=0.003 * np.random.default_rng(0).normal(size=flat.coefficients.shape))


def test_a_parabola_over_one_pane_has_its_heights_slopes_and_bends() -> None:
    """h = P₂(x) = (3x² − 1)/2 over the first pane, whose half side is a; others are flat."""
    flat = flat_panes(PLANE)
    coefficients = np.zeros_like(flat.coefficients)
    coefficients[0, flat.powers.tolist().index([2, 0])] = 1.0
    panes, half = replace(flat, coefficients=coefficients), 1.3 / 6
    x = np.array([-0.9, 0.0, 0.5])
    places = np.stack([-0.65 + half * (1 + x), np.full(3, -0.2)], 1)
    height, slope, across, bend, *others = panes.heights(places)
    np.testing.assert_allclose(height, (3 * x**2 - 1) / 2)
    np.testing.assert_allclose(slope, 3 * x / half)
    np.testing.assert_allclose(bend, 3 / half**2)
    assert not np.any([across, *others])
    assert not panes.heights(places + np.array([2 * half, 0.0])).any()


@pytest.mark.parametrize("degree", [2, 4])
def test_rays_end_on_the_panes_with_their_normals(degree: int) -> None:
    panes, camera = bent(degree), arc(5)[1]
    rays = pixel_rays(camera, np.flatnonzero(PanesMirror(panes).buffers(camera).alpha.numpy() > 0.5))
    hits = panes.hits(*rays)
    points = rays[0] + hits.distance[:, None] * rays[1]
    inner = panes.joint_distance(hits.places) > 0.03
    height, h_u, h_v = panes.heights(points @ panes.frame[:2].T, 1)
    assert hits.met.all()
    assert inner.mean() > 0.5
    np.testing.assert_allclose((points @ NORMAL - PLANE.offset)[inner], height[inner], atol=1e-6)
    np.testing.assert_allclose(hits.slopes[inner], np.stack([h_u, h_v], 1)[inner], atol=1e-4)


def test_a_higher_degree_changes_nothing_at_first() -> None:
    panes, places = bent(), np.random.default_rng(1).uniform(-0.5, 0.5, (40, 2))
    np.testing.assert_allclose(panes.with_halved_cells().heights(places), panes.heights(places), atol=1e-12)


def test_the_tilts_are_those_of_one_plane_and_cost_nothing() -> None:
    panes, places = flat_panes(PLANE), np.random.default_rng(1).uniform(-0.5, 0.5, (40, 2))
    tilt = panes.tilts() @ [0.1, 0.2, 0.3]
    heights = replace(panes, coefficients=tilt.reshape(panes.coefficients.shape)).heights(places)
    np.testing.assert_allclose(heights[1:3], heights[1:3, :1] * np.ones(len(places)))
    assert abs(tilt @ panes.bending() @ tilt) < 1e-12


def test_bars_cover_what_they_do() -> None:
    """Without bars the coverage is that of the plane; bars take their share of its area, seen from straight above."""
    camera = arc(5)[2]
    whole = PanesMirror(flat_panes(PLANE)).buffers(camera).alpha
    torch.testing.assert_close(whole, plane_buffers(PLANE, camera).alpha, atol=1e-5, rtol=0)
    barred = PanesMirror(flat_panes(replace(PLANE, width=0.04))).buffers(camera).alpha
    share = 1 - (1.3 - 2 * 0.04) * (1.0 - 0.04) / 1.3
    assert 1 - float(barred.sum() / whole.sum()) == pytest.approx(share, rel=0.1)


def test_panes_are_read_as_they_were_written() -> None:
    mirror = PanesMirror(replace(bent(), plane=replace(PLANE, width=0.01)))
    again = PanesMirror.from_state_dict(mirror.state_dict())
    assert isinstance(again.height_field, Panes)
    camera = arc(3)[0]
    for one, other in zip(vars(mirror.buffers(camera)).values(), vars(again.buffers(camera)).values(), strict=True):
        torch.testing.assert_close(one, other)


def test_the_mesh_has_the_area_of_the_panes_and_jumps_between_them() -> None:
    panes = bent()
    mesh = PanesMirror(panes).mesh(ObjectFrame(np.zeros(3), 1.0))
    assert mesh.faces is not None
    corners = mesh.vertices[mesh.faces] @ panes.frame[:2].T
    across, up = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    assert (across[:, 0] * up[:, 1] - across[:, 1] * up[:, 0]).sum() == pytest.approx(1.3, rel=1e-3)
    places = mesh.vertices @ panes.frame[:2].T
    np.testing.assert_allclose(mesh.vertices @ NORMAL - PLANE.offset, panes.heights(places, 0)[0], atol=1e-9)
