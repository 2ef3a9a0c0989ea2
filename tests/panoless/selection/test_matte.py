"""A matte object is found before any search, because a place on it shows one color to all cameras."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.capture.views import Photograph, Views, views_of
from panoless.config import FitConfig
from panoless.geometry.registry import FAMILIES
from panoless.selection.candidates import Verdict
from panoless.selection.choose import choose_geometry
from panoless.selection.held_out import is_matte
from shinypartial.core.camera import Camera
from tests.support.mirror_body import camera_rays_world, cameras_around, pattern, photograph, sphere

BODY = sphere(0.9)


def partly_painted(camera: Camera, paint: float) -> Photograph:
    """A share of paint, with waves as fine as those of the surroundings, over a mirror of the rest."""
    mirror = photograph(BODY, camera)
    origins, directions = camera_rays_world(camera, 1)
    distance = BODY.hits(origins, directions)
    points = origins + np.where(np.isfinite(distance), distance, 0.0)[:, None] * directions
    color = pattern(points).T.reshape(3, camera.height, camera.width)
    painted = torch.from_numpy(np.ascontiguousarray(color)).float() * mirror.mask
    return replace(mirror, radiance=paint * painted + (1 - paint) * mirror.radiance)


def views_with(paint: float) -> Views:
    return views_of([partly_painted(camera, paint) for camera in cameras_around(16, 56)])


@pytest.mark.parametrize(("paint", "matte"), [(0.0, False), (0.4, False), (1.0, True)])
def test_a_painted_ball_is_matte_and_a_mirror_below_thin_paint_is_not(paint: float, matte: bool) -> None:
    views, family, config = views_with(paint), FAMILIES["sphere"], FitConfig()
    proposal = family.propose(views, config, requested=True)
    assert proposal is not None
    assert is_matte(views, family.as_proposed(proposal, config), config) == matte


def test_no_other_kind_is_tried_for_a_matte_object() -> None:
    geometry, selection = choose_geometry(views_with(1.0), FitConfig())
    assert geometry.kind == "sphere"
    assert [each.verdict for each in selection.candidates] == [Verdict.CHOSEN]
    assert "as of a matte object" in selection.sentence
