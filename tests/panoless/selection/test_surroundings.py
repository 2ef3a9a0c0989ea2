"""A mirror in a room determines how near its walls are before its shape is fitted."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float

from panoless.capture.rays import pixel_rays, reflect
from panoless.capture.views import TrainView
from panoless.config import FitConfig
from panoless.environment.surroundings import Floor, Surroundings
from panoless.geometry.base import Proposal
from panoless.geometry.height_field.kind import HeightFieldFamily
from panoless.geometry.height_field.model import flat_height_field
from panoless.geometry.plane.kind import PlaneFamily
from panoless.geometry.plane.model import Plane
from panoless.kernels.camera import RasterCamera
from panoless.problem.blocks import Ground, Walls
from panoless.selection.surroundings import explains_clearly_more, proposed_surroundings
from tests.support.mirror_height_field import height_field_views
from tests.support.mirror_plane import RECTANGLE, arc, camera_at, disc, plane_of, reflecting_views
from tests.support.synthetic_dataset import environment_radiance

CONFIG, RAYS = FitConfig(), 10_000
FAR_VIEWS = reflecting_views(plane_of(RECTANGLE), arc(10, size=48))


def in_room(view: TrainView, plane: Plane, radius: float, depth: float | None = None) -> TrainView:
    """The same view with the synthetic environment painted on a sphere about the origin, and on a sheet within 3 radii
    of the point at a depth below it, where there is one.
    """
    everything = np.arange(view.camera.height * view.camera.width)
    origins, rays = pixel_rays(view.camera, everything)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    points = origins + ((plane.offset - origins @ plane.normal) / (rays @ plane.normal))[:, None] * rays
    mirrored = reflect(rays, np.broadcast_to(plane.normal, rays.shape))
    half = (points * mirrored).sum(1)
    reach = np.sqrt(np.maximum(half**2 - (points**2).sum(1) + radius**2, 0))
    walls: Float[np.ndarray, "P 3"] = points + (reach - half)[:, None] * mirrored
    if depth is not None:
        sheet = points - ((depth + points[:, 2]) / mirrored[:, 2])[:, None] * mirrored
        falls = (mirrored[:, 2] < 0) & (np.linalg.norm(sheet[:, :2], axis=1) < 3)
        walls = np.where(falls[:, None], sheet, walls)
    light = environment_radiance(walls / np.linalg.norm(walls, axis=1, keepdims=True)).clip(0, 1)
    image = torch.from_numpy(light.T.reshape(view.radiance.shape)).to(view.radiance)
    return replace(view, radiance=torch.where(view.mask > 0, image, view.radiance))


@pytest.mark.slow
def test_a_flat_mirror_in_a_room_tells_how_near_it_is() -> None:
    """Within 5 % of four radii at 48 px, where a fit that assumes a far world explains clearly less."""
    plane = plane_of(RECTANGLE)
    views = replace(FAR_VIEWS, train=tuple(in_room(view, plane, 4.0) for view in FAR_VIEWS.train))
    family = PlaneFamily()
    proposal = Proposal(plane_of(RECTANGLE), 0.1, 1.0)
    found = proposed_surroundings(family, views, proposal, CONFIG, rays_taken=RAYS)
    assert found.coefficients == pytest.approx([0.25], rel=0.05)
    near, far = (family.as_proposed(each, CONFIG) for each in (proposal.in_surroundings(found), proposal))
    assert near.surroundings is found
    assert explains_clearly_more(views, near, far)
    assert not explains_clearly_more(views, far, near)
    assert proposed_surroundings(
        HeightFieldFamily(), views, proposal, CONFIG, rays_taken=RAYS
    ).coefficients == pytest.approx(found.coefficients, rel=0.02)


@pytest.mark.slow
def test_a_convex_mirror_in_a_far_world_is_not_put_into_a_room() -> None:
    """A flat mirror in near surroundings shows more of the sphere than in far ones, too, as a plane takes it for."""
    plane = plane_of(disc(24))
    views = height_field_views(flat_height_field(plane, 6).domed(0.45), arc(16, size=64))
    proposal = Proposal(plane, 0.0, 1.0)
    assert not proposed_surroundings(PlaneFamily(), views, proposal, CONFIG, rays_taken=RAYS).is_far
    assert proposed_surroundings(HeightFieldFamily(), views, proposal, CONFIG, rays_taken=RAYS).is_far


def above() -> list[RasterCamera]:
    """Around the mirror and held level, at three heights."""
    places = zip(np.radians(np.linspace(-40, 40, 20)), np.radians([12.0, 25.0, 40.0] * 7), strict=False)
    return [
        camera_at(3.0 * np.array([np.cos(up) * np.sin(turn), -np.cos(up) * np.cos(turn), np.sin(up)]), 64)
        for turn, up in places
    ]


@pytest.mark.slow
def test_a_flat_mirror_on_a_table_tells_how_high_it_stands() -> None:
    """Depth within 5 % at 64 px, though the disk that is taken reaches too far. A fit levels one that leans by 10°."""
    plane = plane_of(RECTANGLE)
    views = reflecting_views(plane, above())
    views = replace(views, train=tuple(in_room(view, plane, 6.0, 0.7) for view in views.train))
    proposal = Proposal(plane, 0.1, 1.0)
    found = proposed_surroundings(PlaneFamily(), views, proposal, CONFIG, rays_taken=RAYS)
    assert found.floor is not None
    assert found.floor.depth == pytest.approx(0.7, rel=0.05)
    leaning = np.array([0.15, 0.1, 1.0]) / np.linalg.norm([0.15, 0.1, 1.0])
    wrong = proposal.in_surroundings(replace(found, floor=Floor(leaning, found.floor.depth, 3.0)))
    fitted, _, decisions = PlaneFamily().solve(views, wrong, [Walls, Ground], [Ground.name], CONFIG, lambda _: proposal)
    assert fitted.surroundings.floor is not None
    assert fitted.surroundings.floor.up[2] > np.cos(np.radians(0.5)) > np.cos(np.radians(10)) > leaning[2]
    assert fitted.surroundings.floor.depth == pytest.approx(0.7, rel=0.02)
    assert Ground.name in [each.name for each in decisions if each.kept]


@pytest.mark.slow
def test_a_far_world_stays_far() -> None:
    family = PlaneFamily()
    proposal = Proposal(plane_of(RECTANGLE), 0.1, 1.0)
    assert proposed_surroundings(family, FAR_VIEWS, proposal, CONFIG, rays_taken=RAYS).is_far


def test_walls_are_unknowns_of_a_fit() -> None:
    """From 8 radii they come to 4 within 5 % at 48 px, and go where they are infinitely far."""
    plane = plane_of(RECTANGLE)
    near = replace(FAR_VIEWS, train=tuple(in_room(view, plane, 4.0) for view in FAR_VIEWS.train))
    proposal = Proposal(plane, 0.1, 1.0).in_surroundings(Surroundings(np.array([1 / 8])))
    (fitted, _, needed), (far, _, needless) = (
        PlaneFamily().solve(views, proposal, [Walls], [], CONFIG, lambda _: proposal) for views in (near, FAR_VIEWS)
    )
    assert fitted.surroundings.coefficients == pytest.approx([0.25], rel=0.05)
    assert far.surroundings.is_far
    assert [each.kept for each in (*needed, *needless)] == [True, False]
