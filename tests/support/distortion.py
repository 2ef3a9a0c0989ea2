"""Views through a lens that distorts, by the benchmark's own warp."""

from dataclasses import replace

import numpy as np
import torch

from panoless.capture.views import TrainView, Views
from shinypartial.core.camera import Camera
from shinypartial.core.conventions import SOLID_ALPHA
from shinypartial.dataset.perturb.sensor import undistorted_pixels, warp


def distorted_view(view: TrainView, k1: float) -> TrainView:
    camera = view.camera
    pinhole = Camera(np.eye(4), camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    planes = torch.cat([view.radiance, view.mask[None]]).numpy().transpose(1, 2, 0)
    bent = torch.from_numpy(warp(planes, undistorted_pixels(pinhole, k1)).transpose(2, 0, 1).copy())
    mask = bent[3]
    return replace(view, radiance=bent[:3], mask=mask, solid=torch.nonzero(mask.flatten() > SOLID_ALPHA)[:, 0])


def distorted(views: Views, k1: float) -> Views:
    """The same cameras through such a lens, which nothing says."""
    return replace(views, train=tuple(distorted_view(view, k1) for view in views.train))
