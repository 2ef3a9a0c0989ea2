"""Lenses as photographs have them: a pinhole with radial and tangential distortion, and pictures without it."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from jaxtyping import Float, UInt8

from shinypartial.core.camera import Camera
from shinypartial.core.conventions import PIXEL_CENTER
from shinypartial.core.errors import InputError
from shinypartial.io.records import Positive

INSTALL = "Install it: `pip install 'panoless[capture]'`."


def opencv() -> ModuleType:
    """OpenCV; InputError that names the extra where it is missing."""
    try:
        import cv2
    except ImportError:
        raise InputError(expected="OpenCV, for photographs", found="no module cv2", remedy=INSTALL) from None
    return cv2


@dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels, pixel (0, 0) spanning [0, 1]², and distortion as OpenCV and COLMAP's OPENCV have it.

    A direction (x, y, 1) with r² = x² + y² is seen where (x', y', 1) would be without distortion:
    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²), y' = y (…) + p1 (r² + 2 y²) + 2 p2 x y.
    """

    fx: Positive
    fy: Positive
    cx: float
    cy: float
    width: int
    height: int
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def distortion(self) -> tuple[float, float, float, float, float]:
        """Coefficients in the order of OpenCV."""
        return self.k1, self.k2, self.p1, self.p2, self.k3

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """Intrinsics in OpenCV's pixels, whose centers are whole numbers."""
        cx, cy = self.cx - PIXEL_CENTER, self.cy - PIXEL_CENTER
        return np.array([[self.fx, 0, cx], [0, self.fy, cy], [0, 0, 1]], np.float64)

    def downscaled(self, side: int) -> "Lens":
        """The same lens with pixels as large as blocks of `side` × `side`, without what fills no block."""
        fx, fy, cx, cy = (value / side for value in (self.fx, self.fy, self.cx, self.cy))
        return Lens(fx, fy, cx, cy, self.width // side, self.height // side, *self.distortion)

    def rays(self, pixels: Float[np.ndarray, "*P 2"]) -> Float[np.ndarray, "*P 3"]:
        """Unit rays of pixels, in the camera's frame."""
        if any(self.distortion):
            flat = np.ascontiguousarray(pixels.reshape(-1, 1, 2) - PIXEL_CENTER)
            plane = opencv().undistortPoints(flat, self.matrix, np.array(self.distortion)).reshape(pixels.shape)
        else:
            plane = (pixels - [self.cx, self.cy]) / [self.fx, self.fy]
        rays = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], -1)
        unit: np.ndarray = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return unit

    def project(self, rays: Float[np.ndarray, "*P 3"]) -> Float[np.ndarray, "*P 2"]:
        """Pixels of rays that point forward; others are put at its edge, far outside."""
        x, y = (rays[..., k] / np.maximum(rays[..., 2], 1e-3) for k in (0, 1))
        square = x**2 + y**2
        radial = 1 + square * (self.k1 + square * (self.k2 + square * self.k3))
        moved_x = x * radial + 2 * self.p1 * x * y + self.p2 * (square + 2 * x**2)
        moved_y = y * radial + self.p1 * (square + 2 * y**2) + 2 * self.p2 * x * y
        return np.stack([self.fx * moved_x + self.cx, self.fy * moved_y + self.cy], -1)

    def pinhole(self, camera_to_world: Float[np.ndarray, "4 4"]) -> Camera:
        """The camera of the undistorted picture: it keeps focal length, center and size."""
        return Camera(camera_to_world, self.fx, self.fy, self.cx, self.cy, self.width, self.height)

    def undistorted(self, image: UInt8[np.ndarray, "H W *C"]) -> UInt8[np.ndarray, "H W *C"]:
        """What a pinhole would have seen; zero beyond the picture. Without distortion, the image itself."""
        if not any(self.distortion):
            return image
        cv2 = opencv()
        size = (self.width, self.height)
        maps = cv2.initUndistortRectifyMap(self.matrix, self.distortion, None, self.matrix, size, cv2.CV_32FC1)
        if image.ndim == 2 or image.shape[2] != 4:
            return cv2.remap(np.ascontiguousarray(image), *maps, cv2.INTER_CUBIC)
        # Straight color means nothing where alpha is zero: it must not leak into the edge.
        alpha = image[..., 3:] / np.float32(255)
        moved = cv2.remap(np.concatenate([image[..., :3] * alpha, image[..., 3:]], -1), *maps, cv2.INTER_CUBIC)
        color = moved[..., :3] / np.maximum(moved[..., 3:] / 255, 1 / 255)
        return np.rint(np.clip(np.concatenate([color, moved[..., 3:]], -1), 0, 255)).astype(np.uint8)


def lens_of_model(model: str, parameters: Mapping[str, float], width: int, height: int) -> Lens:
    """The lens of one of COLMAP's camera models, from its parameters by name.

    Raises InputError for models that are not a pinhole with at most k1, k2, p1 and p2.
    """
    known = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"}
    if model not in known:
        raise InputError(
            expected=f"a camera model among {', '.join(sorted(known))}",
            found=model,
            remedy="Run the program again with one of these, such as OPENCV, or undistort with its own tool first.",
        )
    focal = parameters.get("f", 0.0)
    k1 = parameters.get("k1", parameters.get("k", 0.0))
    k2, p1, p2 = (parameters.get(name, 0.0) for name in ("k2", "p1", "p2"))
    fx, fy = parameters.get("fx", focal), parameters.get("fy", focal)
    return Lens(fx, fy, parameters["cx"], parameters["cy"], width, height, k1, k2, p1, p2)
