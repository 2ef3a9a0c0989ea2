"""A mirror in a room tells how near its walls are before its shape is fitted."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float

from panoless.capture.rays import pixel_rays, reflect
from panoless.capture.views import TrainView
from panoless.config import FitConfig
from panoless.environment.options import SurroundingsOptions
from panoless.geometry.base import Proposal
from panoless.geometry.plane.kind import PlaneFamily
from panoless.geometry.plane.model import Plane
from panoless.selection.surroundings import explains_clearly_more, proposed_surroundings
from tests.support.mirror_plane import RECTANGLE, arc, plane_of, reflecting_views
from tests.support.synthetic_dataset import environment_radiance

OPTIONS = SurroundingsOptions(rays=10_000, judged_rays=10_000, resolutions=(8, 8, 16, 16, 32, 32, 32))
CONFIG = FitConfig(surroundings=OPTIONS)
FAR_VIEWS = reflecting_views(plane_of(RECTANGLE), arc(10, size=48))


def in_room(view: TrainView, plane: Plane, radius: float) -> TrainView:
    """The same view with the synthetic environment painted on a sphere about the origin."""
    everything = np.arange(view.camera.height * view.camera.width)
    origins, rays = pixel_rays(view.camera, everything)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    points = origins + ((plane.offset - origins @ plane.normal) / (rays @ plane.normal))[:, None] * rays
    mirrored = reflect(rays, np.broadcast_to(plane.normal, rays.shape))
    half = (points * mirrored).sum(1)
    reach = np.sqrt(np.maximum(half**2 - (points**2).sum(1) + radius**2, 0))
    walls: Float[np.ndarray, "P 3"] = points + (reach - half)[:, None] * mirrored
    light = environment_radiance(walls / np.linalg.norm(walls, axis=1, keepdims=True)).clip(0, 1)
    image = torch.from_numpy(light.T.reshape(view.radiance.shape)).to(view.radiance)
    return replace(view, radiance=torch.where(view.mask > 0, image, view.radiance))


def test_a_flat_mirror_in_a_room_tells_how_near_it_is() -> None:
    """Within 5 % of four radii at 48 px, where a fit that believes in a far world explains clearly less."""
    plane = plane_of(RECTANGLE)
    views = replace(FAR_VIEWS, train=tuple(in_room(view, plane, 4.0) for view in FAR_VIEWS.train))
    family = PlaneFamily()
    proposal = Proposal(plane_of(RECTANGLE), 0.1, 1.0)
    found = proposed_surroundings(family, views, proposal, CONFIG)
    assert found.coefficients == pytest.approx([0.25], rel=0.05)
    near, far = (family.fit(views, each, CONFIG) for each in (proposal.in_surroundings(found), proposal))
    assert near.surroundings is found
    assert explains_clearly_more(views, near, far, CONFIG)
    assert not explains_clearly_more(views, far, near, CONFIG)


def test_a_far_world_stays_far() -> None:
    family = PlaneFamily()
    proposal = Proposal(plane_of(RECTANGLE), 0.1, 1.0)
    assert proposed_surroundings(family, FAR_VIEWS, proposal, CONFIG).is_far
