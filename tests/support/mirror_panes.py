"""A mirror in panes with random slopes and bulges, drawn by its own closed form in numpy."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from panoless.capture.object_frame import ObjectFrame
from panoless.capture.rays import pixel_rays
from panoless.capture.views import Views
from panoless.geometry.panes.model import CutPlane
from panoless.geometry.plane.model import Plane, plane_buffers
from panoless.kernels.camera import RasterCamera
from tests.support.mirror_height_field import patterned
from tests.support.mirror_plane import train_view


def grid_of(plane: Plane, count_u: int, count_v: int, width: float = 0.0) -> CutPlane:
    """So many equal panes along the sides of the boundary's box."""
    low, high = plane.boundary.min(0), plane.boundary.max(0)
    cuts_u, cuts_v = (np.linspace(low[axis], high[axis], n + 1) for axis, n in enumerate((count_u, count_v)))
    return CutPlane(**{**vars(plane), "cuts_u": cuts_u, "cuts_v": cuts_v, "width": width})


def slopes_at(
    plane: CutPlane, places: Float[np.ndarray, "P 2"], tilt: float = 0.01, bulge: float = 0.15, seed: int = 2
) -> Float[np.ndarray, "P 2"]:
    """Slopes of panes, each tilted by up to `tilt` (rad) and bent by `bulge` or against it, at plane coordinates."""
    random = np.random.default_rng(seed)
    shape = len(plane.cuts_u) - 1, len(plane.cuts_v) - 1
    tilts, bends = random.uniform(-tilt, tilt, (*shape, 2)), bulge * random.choice([-1.0, 1.0], shape)
    i, j = (np.clip(np.digitize(places[:, axis], cuts) - 1, 0, len(cuts) - 2) for axis, cuts in enumerate(plane.cuts))
    middles = np.stack([(cuts[each] + cuts[each + 1]) / 2 for cuts, each in zip(plane.cuts, (i, j), strict=True)], 1)
    return tilts[i, j] + bends[i, j][:, None] * (places - middles)


def panes_views(plane: CutPlane, cameras: list[RasterCamera]) -> Views:
    """Views of such panes, whose heights do not move the points that rays meet: normals over the plane."""
    train = []
    for camera in cameras:
        alpha = plane_buffers(plane, camera).alpha.double().numpy()
        view = train_view(camera, alpha)
        origins, directions = pixel_rays(camera, np.arange(alpha.size))
        distance = (plane.offset - origins @ plane.normal) / (directions @ plane.normal)
        points = origins + distance[:, None] * directions
        places = points @ np.stack([plane.tangent_u, plane.tangent_v], 1)
        joints = zip(places.T, plane.cuts, strict=True)
        beside = np.stack([np.abs(line[:, None] - cuts[1:-1]).min(1) for line, cuts in joints], 1)
        alpha = np.where((beside.min(1) < plane.width / 2).reshape(alpha.shape), 0.0, alpha)
        slopes = slopes_at(plane, places)
        normals = plane.normal - slopes @ np.stack([plane.tangent_u, plane.tangent_v])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        outgoing = unit - 2 * (unit * normals).sum(1, keepdims=True) * normals
        radiance = torch.from_numpy(patterned(outgoing).T.reshape(3, *alpha.shape).copy()).float()
        masked = train_view(camera, alpha)
        train.append(replace(view, radiance=radiance * masked.mask, mask=masked.mask, solid=masked.solid))
    return Views(tuple(train), ObjectFrame(np.zeros(3), 1.0), 0.3)
