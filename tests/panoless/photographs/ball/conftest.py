"""Traced photographs of a ball in a far and in a near room, and what is found in them; made once, only read by tests.

In the middle of the ball a pixel spans 1.5°: these pictures are small, so that they are traced within seconds.
"""

from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float

from panoless.photographs.ball.find import FoundBall, find_ball
from panoless.photographs.ball.poses import PosedBalls, posed_balls
from panoless.photographs.lens import Lens
from panoless.photographs.shot import Shot, focal_of
from tests.support.traced_ball import HEIGHT, WIDTH, Room, Scene, camera_at, developed, exif, lens_of

collect_ignore_glob = [] if find_spec("cv2") and find_spec("skimage") else ["test_*.py"]

FAR = Scene(Room(seed=1), person=True)
NEAR = Scene(Room(seed=2, radius=20, place=(3.0, -4.0, 5.0)), person=True)
POSES = [camera_at(azimuth, elevation) for azimuth, elevation in ((0, 12), (90, 20), (180, 12), (250, 25))]
"""From all around: the first and the third stand on opposite sides."""
NOISE = 0.01


def shot_of(
    radiance: Float[np.ndarray, "H W 3"],
    name: str = "ball",
    exposure: float = 1.0,
    stated: bool = False,
    noise: float = NOISE,
) -> Shot:
    """A photograph as if it had been read; its exposure known only where it is stated."""
    codes = developed(radiance, exposure, noise, seed=len(name) + round(1000 * exposure))
    clips_at = 0.966
    return Shot(
        name, Path(f"{name}.jpg"), codes, focal_of(exif(), WIDTH, HEIGHT), exposure if stated else None, clips_at
    )


@dataclass(frozen=True)
class Taken:
    """A scene from several places."""

    scene: Scene
    poses: list[Float[np.ndarray, "4 4"]]
    lens: Lens

    @cached_property
    def radiances(self) -> list[Float[np.ndarray, "H W 3"]]:
        """Linear light, without noise."""
        return [self.scene.radiance(pose, self.lens) for pose in self.poses]

    @cached_property
    def shots(self) -> list[Shot]:
        """Photographs of one exposure."""
        return [shot_of(each, f"p{number}") for number, each in enumerate(self.radiances)]

    @cached_property
    def balls(self) -> list[FoundBall]:
        """What is found in each."""
        return [find_ball(shot) for shot in self.shots]

    @cached_property
    def posed(self) -> PosedBalls:
        """Where the cameras are found."""
        return posed_balls(self.balls, [self.lens] * len(self.balls))

    @property
    def truth(self) -> Float[np.ndarray, "V 3 3"]:
        """World-to-camera rotations."""
        return np.stack([pose[:3, :3].T for pose in self.poses])


@pytest.fixture(scope="session")
def far() -> Taken:
    """Four photographs in surroundings that are infinitely far, nearly."""
    return Taken(FAR, POSES, lens_of())


@pytest.fixture(scope="session")
def near() -> Taken:
    """Four in a room of 20 radii, whose middle is beside the ball."""
    return Taken(NEAR, POSES, lens_of())
