"""A mirror in a room tells how near its walls are before its shape is fitted."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float

from panoless.capture.rays import pixel_rays, reflect
from panoless.capture.views import TrainView
from panoless.config import FitConfig
from panoless.environment.surroundings import Floor, Surroundings
from panoless.geometry.base import Geometry, Proposal
from panoless.geometry.height_field.kind import HeightFieldFamily
from panoless.geometry.height_field.model import flat_height_field
from panoless.geometry.plane.kind import PlaneFamily
from panoless.geometry.plane.model import Plane
from panoless.kernels.camera import RasterCamera
from panoless.selection.surroundings import brought_near, explains_clearly_more, on_floor, proposed_surroundings
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
    """Within 5 % of four radii at 48 px, where a fit that believes in a far world explains clearly less."""
    plane = plane_of(RECTANGLE)
    views = replace(FAR_VIEWS, train=tuple(in_room(view, plane, 4.0) for view in FAR_VIEWS.train))
    family = PlaneFamily()
    proposal = Proposal(plane_of(RECTANGLE), 0.1, 1.0)
    found = proposed_surroundings(family, views, proposal, CONFIG, rays_taken=RAYS)
    assert found.coefficients == pytest.approx([0.25], rel=0.05)
    near, far = (family.fit(views, each, CONFIG) for each in (proposal.in_surroundings(found), proposal))
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
    """Depth within 5 % at 64 px, though the disk that is taken reaches too far. Above a floor that leans by 10° a fit
    goes on above one that leans by less than 3°.
    """
    plane = plane_of(RECTANGLE)
    views = reflecting_views(plane, above())
    views = replace(views, train=tuple(in_room(view, plane, 6.0, 0.7) for view in views.train))
    proposal = Proposal(plane, 0.1, 1.0)
    found = proposed_surroundings(PlaneFamily(), views, proposal, CONFIG, rays_taken=RAYS)
    assert found.floor is not None
    assert found.floor.depth == pytest.approx(0.7, rel=0.05)
    fitted = PlaneFamily().as_proposed(proposal, CONFIG)
    assert fitted is not None
    leaning = np.array([0.15, 0.1, 1.0]) / np.linalg.norm([0.15, 0.1, 1.0])
    wrong = fitted.in_surroundings(replace(found, floor=replace(found.floor, up=leaning)))
    coarse = (16, 32, 32, 32)
    again = on_floor(views, wrong, lambda before, around: before.in_surroundings(around), CONFIG, resolutions=coarse)
    assert again.surroundings.floor is not None
    assert again.surroundings.floor.up[2] > np.cos(np.radians(3)) > np.cos(np.radians(10)) > leaning[2]
    right = fitted.in_surroundings(Surroundings(np.array([1 / 6]), Floor(np.array([0.0, 0.0, 1.0]), 0.7, 3.0)))
    assert on_floor(views, right, lambda *_: pytest.fail("nothing is gained"), CONFIG, resolutions=coarse) is right
    assert on_floor(views, fitted, lambda *_: pytest.fail("there is no floor"), CONFIG) is fitted


@pytest.mark.slow
def test_a_far_world_stays_far() -> None:
    family = PlaneFamily()
    proposal = Proposal(plane_of(RECTANGLE), 0.1, 1.0)
    assert proposed_surroundings(family, FAR_VIEWS, proposal, CONFIG, rays_taken=RAYS).is_far


def test_a_fit_in_a_far_world_is_brought_into_ever_nearer_walls() -> None:
    """Spheres of 10, 5 and 2.5 radii about a mirror in one of 4: the second is the last that explains more. A far
    world stays far.
    """
    plane = plane_of(RECTANGLE)
    views = replace(FAR_VIEWS, train=tuple(in_room(view, plane, 4.0) for view in FAR_VIEWS.train))
    far, tried = PlaneFamily().as_proposed(Proposal(plane, 0.1, 1.0), CONFIG), list[float]()
    assert far is not None

    def follow(before: Geometry, surroundings: Surroundings) -> Geometry:
        tried.extend(surroundings.coefficients)
        return before.in_surroundings(surroundings)

    assert brought_near(views, far, follow, CONFIG).surroundings.coefficients == pytest.approx([0.2])
    assert tried == pytest.approx([0.1, 0.2, 0.4])
    assert brought_near(FAR_VIEWS, far, follow, CONFIG).surroundings.is_far
