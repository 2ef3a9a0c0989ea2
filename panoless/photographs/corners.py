"""Where the corners of a known board are, by all of its print around them.

The board's picture is moved into a frame by its present pose and lens. Around each corner p it then differs from the
frame by a small shift d: I(x) = a P(x) − a d·∇P(x) + b, in least squares over a window. So p + d is where the corner
is, found by dozens of edges in place of two. A corner that something hides is not explained and is left out.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from panoless.photographs.lens import Lens, opencv
from shinypartial.core.board import CELLS_OF_SQUARE, MM, Board

LEAST_MATCH = 0.8
"""Share of the variance around a corner that the print must explain; what something hides is not explained."""
CORNER_WINDOW = 0.7
"""Half side of the window around a corner, in squares of the board."""
CORNER_REACH = 0.15
"""How far a corner may be from where the present pose has it, in squares: a marker's cell is 0.11."""

#: Pixels of the board's picture for each of its cells, and white cells that are added around it.
PIXELS_OF_CELL, PAPER_CELLS = 6, 3
#: Cells at the edge of the board that are left out, because blur brings in what lies beside it.
EDGE_CELLS = 1
#: Standard deviation of the blur that a pixel's own size makes, in pixels: that of a square and a good lens.
PIXEL_BLUR_PX = 0.5
TINY = 1e-12


@dataclass(frozen=True)
class Sighting:
    """Corners of the board that a frame shows."""

    name: str
    corners: Int[np.ndarray, "P"]
    """Their numbers on the board, row by row."""
    places_px: Float[np.ndarray, "P 2"]
    """Where they are, in OpenCV's pixels."""


def corners_of(board: Board) -> Float[np.ndarray, "P 3"]:
    """The inner corners row by row, in meters: x right, y down, z into the board, as OpenCV has them."""
    column, row = np.meshgrid(np.arange(1, board.columns), np.arange(1, board.rows))
    side = board.square_mm * MM
    return np.stack([column * side, row * side, np.zeros_like(row)], -1).reshape(-1, 3).astype(np.float64)


def locate_corners(
    board: Board,
    name: str,
    light: Float[np.ndarray, "H W"],
    lens: Lens,
    camera_to_board: Float[np.ndarray, "4 4"],
    blur_px: float,
) -> Sighting:
    """Corners near where a pose has them, from the luminance of a frame; both are blurred by `blur_px` before."""
    cv2 = opencv()
    board_to_camera = np.linalg.inv(camera_to_board)
    turn = cv2.Rodrigues(board_to_camera[:3, :3])[0]
    points = corners_of(board)
    matrix, distortion = lens.matrix, np.array(lens.distortion)
    expected = cv2.projectPoints(points, turn, board_to_camera[:3, 3], matrix, distortion)[0][:, 0]
    depth = float(board_to_camera[2] @ np.append(points.mean(0), 1.0))
    square_px = lens.fx * board.square_mm * MM / max(depth, TINY)
    half = max(round(CORNER_WINDOW * square_px), 3)
    # What lies farther from the corners than two windows is not looked at.
    low = np.clip(np.floor(expected.min(0)).astype(int) - 2 * half, 0, [lens.width - 1, lens.height - 1])
    high = np.clip(np.ceil(expected.max(0)).astype(int) + 2 * half, low + 1, [lens.width, lens.height])
    part = light[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    picture, known = _expected_picture(board, lens, camera_to_board, square_px / CELLS_OF_SQUARE, low, high)
    shifts, match = _shifts(_blurred(part, blur_px), _blurred(picture, blur_px), known, expected - low, half)
    inside = (expected > half).all(1) & (expected < np.array([lens.width, lens.height]) - 1 - half).all(1)
    near = np.linalg.norm(shifts, axis=1) < CORNER_REACH * square_px
    kept: Bool[np.ndarray, "P"] = inside & near & (match > LEAST_MATCH)
    return Sighting(name, np.flatnonzero(kept), (expected + shifts)[kept])


def _blurred(image: Float[np.ndarray, "H W"], sigma_px: float) -> Float[np.ndarray, "H W"]:
    return opencv().GaussianBlur(image, (0, 0), sigma_px) if sigma_px else image


def _expected_picture(
    board: Board,
    lens: Lens,
    camera_to_board: Float[np.ndarray, "4 4"],
    cell_px: float,
    low: Int[np.ndarray, "2"],
    high: Int[np.ndarray, "2"],
) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """The board as a part of the frame would show it, 1 where it is white, and 1 where that is known: not beside it."""
    cv2 = opencv()
    white = np.pad(~board.cells(), PAPER_CELLS, constant_values=True).astype(np.float32)
    print_px = np.repeat(np.repeat(white, PIXELS_OF_CELL, 0), PIXELS_OF_CELL, 1)
    print_px = cv2.GaussianBlur(print_px, (0, 0), PIXEL_BLUR_PX * PIXELS_OF_CELL / cell_px)
    size = high - low
    grid = np.stack(np.meshgrid(*(np.arange(*ends) for ends in zip(low, high, strict=True))), -1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(grid.astype(np.float64), lens.matrix, np.array(lens.distortion))[:, 0]
    directions = np.concatenate([rays, np.ones((len(rays), 1))], -1) @ camera_to_board[:3, :3].T
    along = -camera_to_board[2, 3] / np.where(np.abs(directions[:, 2]) < TINY, TINY, directions[:, 2])
    meters = camera_to_board[:2, 3] + along[:, None] * directions[:, :2]
    cells = meters / (board.square_mm * MM / CELLS_OF_SQUARE) + PAPER_CELLS
    places = np.where((along > 0)[:, None], cells * PIXELS_OF_CELL - 0.5, -1e3).astype(np.float32)
    columns, rows = places.reshape(size[1], size[0], 2).transpose(2, 0, 1)
    size_cells = np.array(board.cells().shape[::-1])
    within = ((cells - PAPER_CELLS - EDGE_CELLS > 0) & (cells - PAPER_CELLS + EDGE_CELLS < size_cells)).all(1)
    known = (within & (along > 0)).reshape(size[1], size[0]).astype(np.float32)
    picture = cv2.remap(print_px, columns.copy(), rows.copy(), cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, 1.0)
    return picture, known


def _shifts(
    image: Float[np.ndarray, "H W"],
    picture: Float[np.ndarray, "H W"],
    known: Float[np.ndarray, "H W"],
    expected: Float[np.ndarray, "P 2"],
    half: int,
) -> tuple[Float[np.ndarray, "P 2"], Float[np.ndarray, "P"]]:
    """Shift d of each window, and the share of its variance that is explained."""
    cv2 = opencv()
    slope_y, slope_x = np.gradient(picture)
    columns = [picture, -slope_x, -slope_y, np.ones_like(picture)]
    image = image / max(float(image.max()), TINY)  # So that sums of squares lose no digits.
    at = np.clip(np.rint(expected).astype(int), 0, np.array(image.shape[::-1]) - 1)

    def mean(product: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "P"]:
        return cv2.boxFilter(known * product, cv2.CV_64F, (2 * half + 1,) * 2)[at[:, 1], at[:, 0]]

    products = np.empty((len(at), len(columns), len(columns)))
    for i, a in enumerate(columns):
        for j, b in enumerate(columns[: i + 1]):
            products[:, i, j] = products[:, j, i] = mean(a * b)
    sides = np.stack([mean(a * image) for a in columns], -1)
    solved = np.einsum("pij,pj->pi", np.linalg.pinv(products, rcond=1e-9, hermitian=True), sides)
    of_mean = sides[:, 3] ** 2 / np.maximum(products[:, 3, 3], TINY)
    total = mean(image * image) - of_mean
    explained = np.sum(solved * sides, -1) - of_mean
    contrast = solved[:, :1]
    return solved[:, 1:3] / np.where(contrast > TINY, contrast, np.inf), explained / np.maximum(total, TINY)
