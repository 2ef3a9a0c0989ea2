"""What hides the surroundings: rays over shapes of closed form, parts that float, and pictures shaded with it."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from panoless.capture.views import Views
from panoless.kernels.camera import RasterCamera
from panoless.splats.mirror import SurfelMirror
from panoless.splats.shading.base import points_at
from panoless.splats.shading.geometry import ShadedMirror
from panoless.splats.shading.objective import ShadedObjective, occluder_of
from panoless.splats.shading.occlusion import CELL, DepthMap, Occluder
from panoless.splats.train import SurfelTrainer
from tests.panoless.splats.test_shading import method_config, mirrors, shell, sphere, world
from tests.support.surfel_training import Unobserved, new_trainer

BALLS = torch.tensor([[-0.45, 0.0, 0.0, 0.4], [0.45, 0.1, 0.0, 0.4]])
"""Centers and radii of two balls that mirror each other."""
JOINED = torch.tensor([0.0, 0.05, 0.0, 0.2])
"""A third one between them, so that they are one object."""


def first_hits(
    origins: Float[Tensor, "P 3"], directions: Float[Tensor, "P 3"], balls: Float[Tensor, "B 4"]
) -> Float[Tensor, "P"]:
    """Distance along rays to the nearest ball, by the quadratic equation; infinite for a miss."""
    off = origins[:, None] - balls[:, :3]
    along = (off * directions[:, None]).sum(-1)
    inside = along.square() - off.square().sum(-1) + balls[:, 3].square()
    near = -along - inside.clamp(min=0).sqrt()
    return torch.where((inside > 0) & (near > 1e-3), near, torch.inf).amin(1)


def camera_at(position: Float[np.ndarray, "3"], pixels: int = 200) -> RasterCamera:
    """A camera that looks at the origin."""
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return RasterCamera(torch.from_numpy(pose).float(), 300.0, 300.0, pixels / 2, pixels / 2, pixels, pixels)


def rays_of(camera: RasterCamera) -> tuple[Float[Tensor, "3"], Float[Tensor, "P 3"]]:
    """Center and unit world directions of all pixels."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    local = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1)
    turn, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return -turn.T @ shift, normalize(local.view(-1, 3) @ turn, dim=1)


def seen(camera: RasterCamera, balls: Float[Tensor, "B 4"]) -> DepthMap:
    """Depth and coverage of balls in closed form."""
    center, directions = rays_of(camera)
    distance = first_hits(center.expand_as(directions), directions, balls)
    hit = distance.isfinite()
    depth = torch.where(hit, distance, 0) * (directions @ camera.world_to_camera[2, :3])
    shape = camera.height, camera.width
    return DepthMap(camera, depth.view(shape), hit.float().view(shape))


def around(count: int = 24) -> Iterator[RasterCamera]:
    """Cameras on a spiral about the object."""
    for index in range(count):
        z, angle = 0.9 * (2 * (index + 0.5) / count - 1), 2.4 * index
        across = (1 - z * z) ** 0.5
        yield camera_at(3 * np.array([across * np.cos(angle), across * np.sin(angle), z]))


def mirrored_rays(balls: Float[Tensor, "B 4"]) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """From points that a camera sees, out of where it sees them mirror to."""
    center, directions = rays_of(camera_at(np.array([0.3, -2.8, 0.9])))
    distance = first_hits(center.expand_as(directions), directions, balls)
    hit = distance.isfinite()
    points = center + directions[hit] * distance[hit, None]
    ball = (points[:, None] - balls[:, :3]).norm(dim=-1).sub(balls[:, 3]).abs().argmin(1)
    normals = (points - balls[ball, :3]) / balls[ball, 3:]
    return points, directions[hit] - 2 * (directions[hit] * normals).sum(1, keepdim=True) * normals


def test_rays_meet_the_surface_where_closed_form_says_so() -> None:
    """Two balls with a joint: which mirrored rays meet the object again, but for those that pass it closely, or meet
    it within six cells, in the crease.
    """
    balls = torch.cat([BALLS, JOINED[None]])
    occluder = Occluder.fused(seen(camera, balls) for camera in around())
    points, directions = mirrored_rays(balls)
    distance = first_hits(points, directions, balls)
    truth = distance.isfinite()
    thinner, thicker = (torch.cat([balls[:, :3], balls[:, 3:] + change], 1) for change in (-0.04, 0.04))
    deep = first_hits(points, directions, thinner).isfinite()
    surely_hidden = truth & deep & (distance > 6 * CELL)
    surely_free = ~truth & ~first_hits(points + 0.1 * directions, directions, thicker).isfinite()
    found = occluder.hides(points, directions).float()
    assert float(surely_hidden.float().mean()) > 0.02
    assert float(surely_free.float().mean()) > 0.7
    assert float(found[surely_hidden].mean()) > 0.98
    assert float(found[surely_free].mean()) < 0.005


def test_a_convex_object_hides_nothing() -> None:
    ball = torch.tensor([[0.1, 0.0, -0.1, 0.8]])
    occluder = Occluder.fused(seen(camera, ball) for camera in around())
    assert float(occluder.hides(*mirrored_rays(ball)).float().mean()) < 0.002


def test_what_floats_beside_the_object_hides_nothing() -> None:
    """A small ball apart from a large one, in the way of rays that the large one mirrors."""
    balls = torch.tensor([[-0.2, 0.0, 0.0, 0.6], [0.75, -0.5, 0.0, 0.15]])
    occluder = Occluder.fused(seen(camera, balls) for camera in around())
    points, directions = mirrored_rays(balls)
    large = (points - balls[0, :3]).norm(dim=1) < 0.61
    points, directions = points[large], directions[large]
    assert float(first_hits(points, directions, balls).isfinite().float().mean()) > 0.005
    assert float(occluder.hides(points, directions).float().mean()) < 0.002


def test_no_rays_are_hidden_by_none() -> None:
    occluder = Occluder(torch.ones(4, 4, 4))
    assert occluder.hides(torch.zeros(0, 3), torch.zeros(0, 3)).shape == (0,)


def test_points_lie_at_their_depth() -> None:
    camera = camera_at(np.array([1.0, 2.0, 0.5]))
    _, directions = rays_of(camera)
    pixels = torch.tensor([3, 7777, 39_999])
    points = points_at(camera, torch.full((200, 200), 2.5), pixels, directions[pixels])
    local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    assert torch.allclose(local[:, 2], torch.tensor(2.5), atol=1e-5)


@pytest.fixture(scope="module")
def mirror(views: Views) -> ShadedMirror:
    """A ball of metal, shaded by pixels."""
    return ShadedMirror(mirrors(sphere("ref-gaussian", views)), curved=False, shading="ref-gaussian", share=1.0)


def test_hidden_pixels_show_the_light_of_the_object(mirror: ShadedMirror, views: Views) -> None:
    """Where all is hidden no map is seen, and what primitives hold is: c Y₀ for a coefficient of degree 0."""
    camera, pixels = views.train[0].camera, views.train[0].solid
    surfels = mirror.surfels
    light = torch.zeros_like(surfels.indirect_harmonics)  # type: ignore[attr-defined]
    light[:, 0] = torch.tensor([0.2, 0.4, 0.8])
    hidden = replace(mirror, surfels=replace(surfels, indirect_harmonics=light), occluder=shell())  # type: ignore[call-arg]
    shown = hidden.shade(world(), camera, pixels, torch.zeros(3, len(pixels)))
    assert torch.allclose(shown, light[0, 0] / (4 * torch.pi) ** 0.5, atol=2e-3)
    open_air = replace(hidden, occluder=Occluder(torch.ones(8, 8, 8)))
    unknown = replace(hidden, occluder=None)
    first, second = (each.shade(world(), camera, pixels, torch.zeros(3, len(pixels))) for each in (open_air, unknown))
    assert torch.equal(first, second)


def test_hidden_rays_are_no_evidence_of_the_map(mirror: ShadedMirror, views: Views) -> None:
    view = views.train[0]
    assert len(mirror.observe(view, view.solid).directions) > 0
    assert len(replace(mirror, occluder=shell()).observe(view, view.solid).directions) == 0


def test_surfels_that_make_a_ball_hide_nothing_of_it(mirror: ShadedMirror, views: Views) -> None:
    """The occluder that is made of their own depth, over the rays that they mirror."""
    cameras = [view.camera for view in views.train]
    own = occluder_of(mirror.surfels, cameras)  # type: ignore[arg-type]
    view = views.train[0]
    free, kept = (len(each.observe(view, view.solid).directions) for each in (mirror, replace(mirror, occluder=own)))
    assert kept > 0.97 * free


@pytest.mark.parametrize("name", ["3dgs-dr", "gaussian-shader", "material-refgs"])
def test_other_methods_hold_no_light_of_the_object(name: str, views: Views) -> None:
    assert sphere(name, views).indirect_harmonics.numel() == 0


def test_a_fit_that_is_continued_traces_what_it_traced_before(views: Views) -> None:
    """The grid is made at steps of its own; between them it comes from the checkpoint."""
    config = method_config("ref-gaussian", iterations=40, count=150)
    whole = new_trainer(views, config)
    for _ in range(21):
        whole.step()
    stopped, training = whole.current()
    again = SurfelTrainer(views, SurfelMirror.from_state_dict(stopped.state_dict()), training, config, Unobserved())
    assert isinstance(again._objective, ShadedObjective)
    assert again._objective.occluder is not None
    # Two steps from the next grid, of 16, 18, 20, 22, …
    for trainer in (whole, again):
        trainer.step()
    for name, value in whole.optimizer.surfels.named().items():
        assert torch.equal(value, again.optimizer.surfels.named()[name]), name
