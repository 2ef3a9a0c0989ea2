"""A mirror in a room tells how near its walls are before its shape is fitted."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float

from panoless.alignment.search import PosedProposal
from panoless.capture.rays import pixel_rays, reflect
from panoless.capture.views import TrainView, Views
from panoless.config import FitConfig
from panoless.environment.options import SurroundingsOptions
from panoless.environment.surroundings import Surroundings
from panoless.geometry.base import Geometry, Proposal
from panoless.geometry.plane.kind import PlaneFamily
from panoless.geometry.plane.model import Plane
from panoless.selection.choose import _first_fit
from panoless.selection.surroundings import brought_near, explains_clearly_more, proposed_surroundings
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


class CountedPlanes(PlaneFamily):
    """Planes that count how often they are fitted."""

    fits = 0

    def fit(self, views: Views, proposal: Proposal, config: FitConfig) -> Geometry:
        """Counted."""
        self.fits += 1
        return super().fit(views, proposal, config)


def test_surroundings_that_a_fit_before_found_are_not_compared_with_a_far_world() -> None:
    plane = plane_of(RECTANGLE)
    views = replace(FAR_VIEWS, train=tuple(in_room(view, plane, 4.0) for view in FAR_VIEWS.train))
    family, known = CountedPlanes(), Surroundings(np.array([0.25]))
    start = [PosedProposal(Proposal(plane, 0.1, 1.0))]
    first = _first_fit(family, start, views, CONFIG)
    assert first is not None
    assert not first.geometry.surroundings.is_far
    assert family.fits == 2
    again = _first_fit(family, start, views, CONFIG, known)
    assert again is not None
    assert again.geometry.surroundings is known
    assert family.fits == 3


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
