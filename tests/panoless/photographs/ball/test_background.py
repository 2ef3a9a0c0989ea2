"""What lies past a ball is light of its surroundings, in the directions in which the ball mirrors them."""

from pathlib import Path

import numpy as np
import pytest
import torch

from panoless.capture.background import Background, load_background
from panoless.capture.encoding import LDR
from panoless.environment.direct import scaled_to_map
from panoless.environment.rays import Rays
from panoless.kernels.cubemap import cubemap_directions
from panoless.photographs.ball.background import ROWS, past_balls, write_background
from panoless.photographs.ball.beside import PosedBall, log_light
from panoless.photographs.ball.cone import BallCone
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import latlong_directions
from shinypartial.dataset.schema import BACKGROUND, Dataset
from tests.panoless.photographs.ball.conftest import Taken


def posed(taken: Taken) -> list[PosedBall]:
    """By the true cameras."""
    balls = []
    for pose, shot in zip(taken.poses, taken.shots, strict=True):
        rotation = pose[:3, :3].T
        center = -rotation @ pose[:3, 3]
        distance = float(np.linalg.norm(center))
        balls.append(PosedBall(log_light(shot.pixels), taken.lens, BallCone(center / distance, distance), rotation))
    return balls


def test_light_past_a_ball_is_that_of_its_surroundings(far: Taken) -> None:
    """A pixel spans a third of a degree, and neither ball nor support nor photographer is part of it."""
    light, seen = past_balls(posed(far), [each.astype(np.float32) for each in far.radiances], np.inf)
    directions = latlong_directions(ROWS)[seen]
    truth = far.scene.room.light(np.zeros_like(directions), directions)
    assert seen.mean() > 0.05
    assert np.median(np.abs(light[seen] / truth - 1)) < 0.03
    assert np.percentile(np.abs(light[seen] / truth - 1), 90) < 0.3


def test_a_mirror_takes_its_share_of_each_channel() -> None:
    """Where both kinds of light are seen, whatever direct views saw elsewhere."""
    toward = cubemap_directions(64).permute(0, 2, 3, 1).reshape(-1, 3)
    light = 0.3 + 0.2 * toward
    share = torch.tensor([0.5, 0.6, 0.7])
    mirrored = toward[:, 2] > 0
    direct = light / share * torch.where(mirrored, 1.0, 3.0)[:, None]
    rays = [Rays(toward[mirrored], light[mirrored])]
    found = scaled_to_map(Background(toward, direct, torch.ones_like(direct[:, 0])), rays)
    torch.testing.assert_close(found.radiance[mirrored], light[mirrored], rtol=0.02, atol=0)


def test_a_background_is_read_as_it_was_written(far: Taken, tmp_path: Path) -> None:
    write_background(tmp_path / BACKGROUND, posed(far)[:1], [far.radiances[0].astype(np.float32)], np.inf)
    dataset = Dataset(tmp_path, {}, (), ())
    found = load_background(dataset, LDR)
    light, seen = past_balls(posed(far)[:1], [far.radiances[0].astype(np.float32)], np.inf)
    torch.testing.assert_close(found.radiance, torch.from_numpy(light[seen]).float())
    torch.testing.assert_close(found.directions, torch.from_numpy(latlong_directions(ROWS)[seen]).float())
    (tmp_path / BACKGROUND).write_bytes(b"no picture")
    with pytest.raises(InputError, match=BACKGROUND):
        load_background(dataset, LDR)
