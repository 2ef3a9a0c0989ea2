"""The constitution: frames, axes, face order and pixel centres that every room imports.

World: right-handed, +Z up, scene units. Camera in memory: OpenCV axes (+x right, +y down, +z forward).
Camera in `transforms.json`: OpenGL/Blender axes (+x right, +y up, −z forward). Pixel (0, 0) spans [0, 1]², so its
center lies at 0.5. Rays point from the camera to the surface. Lat-long maps have shape (H, 2H, 3), row 0 looks
along +Z and the image center along +X. Cubemap faces follow FACES with the orientation of OpenGL 4.6 table 8.19.
"""

import math

import numpy as np

FACES = ("px", "nx", "py", "ny", "pz", "nz")
PIXEL_CENTER = 0.5

#: Of 35 mm film, 36 × 24 mm, to which EXIF relates focal lengths by diagonals.
FILM_DIAGONAL_MM = math.hypot(36, 24)
INCH_MM = 25.4

#: Multiplies the columns of a camera-to-world matrix: OpenGL axes ⇄ OpenCV axes (its own inverse).
OPENGL_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])

#: Columns are the Y-up axes x, y, z in the world: direction_world = Y_UP_TO_WORLD · direction, (x, y, z) ↦ (x, −z, y).
Y_UP_TO_WORLD = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])

#: For each face, the world-axis coefficients of (sc, tc, ma): direction = ma + s·sc + t·tc (OpenGL 4.6, table 8.19).
FACE_AXES = np.array(
    [
        [[0, 0, -1], [0, -1, 0], [1, 0, 0]],
        [[0, 0, 1], [0, -1, 0], [-1, 0, 0]],
        [[1, 0, 0], [0, 0, 1], [0, 1, 0]],
        [[1, 0, 0], [0, 0, -1], [0, -1, 0]],
        [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
        [[-1, 0, 0], [0, -1, 0], [0, 0, -1]],
    ],
    dtype=np.float64,
)

#: Alpha above which a pixel counts as lying wholly on the object: its normal and color are not mixed with another.
SOLID_ALPHA = 0.99

#: 8-bit alpha of pixels on the object whose light is not known: something hides them, or they are clipped. They belong
#: to its silhouette, and lie below SOLID_ALPHA.
HIDDEN_ALPHA = 250
