"""What a ball mirrors, as pictures that a camera at the ball would take, and features of them.

Faces with a field of view of 84° look in 20 directions of the frame that faces the camera. Each direction belongs to
the face that looks nearest to it, so that none is counted twice. Left out are directions toward the camera, where its
photographer stands, and those beside the rim, of which a pixel spans too much.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.spatial.transform import Rotation

from panoless.photographs.ball.cone import BallCone, Sighting
from panoless.photographs.lens import Lens, opencv

FIELD_DEG = 84.0
RINGS = ((-60.0, 6), (0.0, 8), (60.0, 6))
"""Elevations of the faces and how many there are at each."""
PHOTOGRAPHER_DEG = 15.0
"""About the camera; what stands there moves with it."""
WIDEST_PIXEL_RAD = 0.15
"""That a pixel may span where features are looked for."""
FEATURES = 90
"""Of a face."""


@dataclass(frozen=True)
class Features:
    """Descriptors of what a ball mirrors, and which rays mirror it."""

    descriptors: Float32[np.ndarray, "P 128"]
    """Square roots of SIFT's, of length 1."""
    pixels: Float[np.ndarray, "P 2"]
    """Where they are in the picture, pixel (0, 0) spanning [0, 1]²."""
    seen: Sighting
    sigma: Float[np.ndarray, "P"]
    """Angle (rad) that a pixel spans there."""

    @classmethod
    def none(cls, cone: BallCone) -> "Features":
        """Of a ball without any."""
        return cls(np.zeros((0, 128), np.float32), np.zeros((0, 2)), cone.along(np.zeros((0, 3))), np.zeros(0))

    def __len__(self) -> int:
        return len(self.pixels)


def faces() -> Float[np.ndarray, "F 3 3"]:
    """Rotations whose rows are the axes of each face (right, down, forward) in the frame that faces the camera."""
    return np.stack(
        [
            Rotation.from_euler("YX", [azimuth, elevation], degrees=True).as_matrix().T
            for elevation, count in RINGS
            for azimuth in np.arange(count) * 360.0 / count
        ]
    )


def spans(cone: BallCone, seen: Sighting, lens: Lens) -> Float[np.ndarray, "*P"]:
    """Angle (rad) that a pixel spans along the radius: 2/(ρ cos θ) with the ball's radius ρ in pixels."""
    radius_px = lens.fx * np.tan(cone.half_angle)
    angle: np.ndarray = 2 / (radius_px * np.maximum(seen.cosines, 1e-3))
    return angle


def usable(
    cone: BallCone, seen: Sighting, lens: Lens, unseen: Bool[np.ndarray, "H W"] | None
) -> Bool[np.ndarray, "*P"]:
    """Where features may lie."""
    away = seen.directions @ -cone.axis < np.cos(np.radians(PHOTOGRAPHER_DEG))
    good = seen.met & away & (spans(cone, seen, lens) < WIDEST_PIXEL_RAD)
    if unseen is not None:
        pixels = np.floor(lens.project(seen.rays)).astype(np.int64)
        columns, rows = (pixels[..., k].clip(0, unseen.shape[1 - k] - 1) for k in (0, 1))
        good &= ~unseen[rows, columns]
    return good


def features_of(
    gray: UInt8[np.ndarray, "H W"], cone: BallCone, lens: Lens, unseen: Bool[np.ndarray, "H W"] | None = None
) -> Features:
    """Features of what a ball mirrors in a picture; `unseen` marks pixels that something hides or that lie outside."""
    cv2 = opencv()
    half = np.tan(np.radians(FIELD_DEG / 2))
    size = int(np.clip(1.9 * lens.fx * np.tan(cone.half_angle) / 2, 96, 224))
    grid = ((np.arange(size) + 0.5) / size * 2 - 1) * half
    right, down = np.meshgrid(grid, grid)
    rays = np.stack([right, down, np.ones_like(right)], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    rotations = faces()
    contrast = cv2.createCLAHE(3.0, (4, 4))
    detector = cv2.SIFT_create(nfeatures=FEATURES, contrastThreshold=0.02)
    descriptors, pixels = [], []
    for number, rotation in enumerate(rotations):
        if rotation[2, 2] < -0.8:
            continue
        in_face = rays @ rotation
        seen = cone.toward(in_face @ cone.facing)
        at = lens.project(seen.rays) - 0.5
        picture = cv2.remap(gray, at.astype(np.float32), None, cv2.INTER_LINEAR)
        nearest = (in_face @ rotations[:, 2].T).argmax(-1) == number
        shown = cv2.erode(usable(cone, seen, lens, unseen).astype(np.uint8), np.ones((7, 7), np.uint8))
        points, found = detector.detectAndCompute(contrast.apply(picture), shown * nearest.astype(np.uint8))
        if not points:
            continue
        place = (np.array([point.pt for point in points]) + 0.5) / size * 2 - 1
        toward = np.concatenate([place * half, np.ones((len(place), 1))], 1) @ rotation @ cone.facing
        sighted = cone.toward(toward / np.linalg.norm(toward, axis=1, keepdims=True))
        descriptors.append(found)
        pixels.append(lens.project(sighted.rays))
    if not pixels:
        return Features.none(cone)
    stacked, places = np.concatenate(descriptors), np.concatenate(pixels)
    roots = np.sqrt(stacked / np.maximum(stacked.sum(1, keepdims=True), 1e-9)).astype(np.float32)
    seen = cone.along(lens.rays(places))
    return Features(roots, places, seen, spans(cone, seen, lens))
