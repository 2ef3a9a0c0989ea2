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
