"""Photographs of pictures in space by known cameras: homographies, which know nothing of boards or matching."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from shinypartial.core.camera import Camera, look_at, project

PICTURE_PX = 4
"""Blocks over which a photograph is averaged, so that edges are as a sensor has them."""


def arc(
    count: int, distance: float, size: tuple[int, int], focal_px: float, target: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> list[Camera]:
    """Cameras on a wave about a target, elevations 35° to 65°."""
    cameras = []
    for i in range(count):
        azimuth, elevation = np.radians(-60 + 120 * i / (count - 1)), np.radians(50 + 15 * np.sin(2.4 * i))
        away = np.array([np.cos(elevation) * np.sin(azimuth), -np.cos(elevation) * np.cos(azimuth), np.sin(elevation)])
        pose = look_at(np.array(target) + distance * away, np.array(target))
        cameras.append(Camera(pose, focal_px, focal_px, size[0] / 2, size[1] / 2, *size))
    return cameras


def photograph(
    camera: Camera, planes: Sequence[tuple[UInt8[np.ndarray, "_ _"], Float[np.ndarray, "4 3"]]], gray: int = 90
) -> UInt8[np.ndarray, "H W"]:
    """What a pinhole sees of pictures whose corners (top left, top right, bottom right, bottom left) lie in space."""
    import cv2

    width, height = camera.width * PICTURE_PX, camera.height * PICTURE_PX
    seen = np.full((height, width), gray, np.uint8)
    for picture, corners in planes:
        # OpenCV's pixels have their centers at whole numbers.
        places = (project(camera, corners)[:, :2] * PICTURE_PX - 0.5).astype(np.float32)
        rows, columns = picture.shape
        sides = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], np.float32) - 0.5
        homography = cv2.getPerspectiveTransform(sides, places)
        cv2.warpPerspective(picture, homography, (width, height), seen, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT)
    return cv2.resize(seen, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
