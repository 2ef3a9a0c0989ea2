"""Direct views of the environment as rays beside those that are mirrored."""

from collections.abc import Sequence

import numpy as np
import torch

from panoless.capture.background import Background
from panoless.capture.ground import Ground
from panoless.capture.views import Views
from panoless.environment.rays import Rays, joined_rays
from panoless.environment.resolution import count_rays
from panoless.environment.solve import solve_environment
from panoless.environment.surroundings import Floor, Surroundings
from panoless.kernels.cubemap import sample_cubemap

RESOLUTION = 32
"""Texels along a face side of the map by which both kinds of light are compared: 2.8°. Not tuned."""


def direct_rays(views: Views, surroundings: Surroundings, rays: Sequence[Rays]) -> Rays:
    """What is seen past the object as rays beside those that are mirrored: light past a ball, and the ground that is
    stated, as far as these surroundings have a floor; none where there is neither.
    """
    found = [] if views.background is None else [views.background]
    if views.ground is not None and surroundings.floor is not None:
        found.append(ground_light(views.ground, surroundings.floor))
    none = Rays(rays[0].directions[:0], rays[0].radiance[:0])
    return joined_rays([none, *(scaled_to_map(each, rays) for each in found if len(each.weight))])


def ground_light(ground: Ground, floor: Floor) -> Background:
    """The light of a ground within the reach of a floor."""
    directions, reach = ground.light.directions, float(np.hypot(floor.depth, floor.reach))
    falls = -directions @ torch.from_numpy(ground.up).to(directions)
    near = ground.depth < reach * falls
    return Background(*(part[near] for part in vars(ground.light).values()))


def scaled_to_map(background: Background, rays: Sequence[Rays]) -> Rays:
    """Direct light c times g, one factor a channel: the median of E(ω)/c over directions that are mirrored, too.

    E is the map of the mirrored rays; ones where no direction is seen in both ways.
    """
    environment = solve_environment(rays, RESOLUTION)
    seen = sample_cubemap(environment, background.directions)
    mirrored = sample_cubemap((count_rays(rays, RESOLUTION) > 0).float(), background.directions)[:, 0] > 0.5
    both = mirrored & (background.radiance > 0).all(1)
    gain = (seen / background.radiance)[both].median(0).values if both.any() else torch.ones_like(seen[0])
    return Rays(background.directions, gain * background.radiance, background.weight)
