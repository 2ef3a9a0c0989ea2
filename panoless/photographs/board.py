"""A ChArUco board under the object: to print, and as the measure of cameras."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from panoless.photographs.certainty import SeenPoints
from panoless.photographs.corners import Sighting, corners_of, locate_corners
from panoless.photographs.frames import Frames
from panoless.photographs.lens import Lens, opencv
from panoless.photographs.options import LEAST_VIEWS
from panoless.photographs.posed import LEVEL, PosedView, Poses, as_rows, with_covariances
from panoless.photographs.video import luminance
from shinypartial.core.board import BOARDS, CELLS_OF_MARKER, CELLS_OF_SQUARE, MM, Board
from shinypartial.core.errors import InputError
from shinypartial.io.files import atomic_write, write_text
from shinypartial.io.images import read_png

BOARD_FRAMES = 8
"""Frames in which a board that nobody named is looked for: half of them must show it."""
LEAST_CORNERS = 8
"""Corners of the board that a frame must show; a pose needs four, and more make it certain."""
MOST_FOCAL_ERROR = 0.02
"""Standard deviation of the focal length, as a share of it, above which the frames do not determine it."""
CORNER_BLURS_PX = (1.5, 0.7, 0.7)
"""Rounds in which corners are located by the print around them, each with a blur of both (px)."""

#: From the board's axes (x right, y down, z into it) to the world's: x right, y up the sheet, z out of it.
BOARD_TO_WORLD = np.diag([1.0, -1.0, -1.0, 1.0])
OUTLIER_ROUNDS = 3
#: Corners from which the pose of a frame can be found at all, to look for more of them.
CORNERS_OF_POSE = 4
POINTS_PER_MM = 72 / 25.4


def drawn_by_opencv(board: Board) -> Any:
    """The board as OpenCV has it, in meters."""
    aruco = opencv().aruco
    side = board.square_mm * MM
    dictionary = aruco.getPredefinedDictionary(aruco.DICT_5X5_100)
    return aruco.CharucoBoard((board.columns, board.rows), side, side * CELLS_OF_MARKER / CELLS_OF_SQUARE, dictionary)


def write_board(board: Board, path: Path) -> None:
    """Write the board at its true size as PDF or SVG, by the suffix of the file; InputError for another one."""
    writers = {".pdf": _write_pdf, ".svg": _write_svg}
    if path.suffix.lower() not in writers:
        raise InputError(expected="a board as .pdf or .svg", found=path.name, remedy="Change --output.")
    writers[path.suffix.lower()](board, path)


def _bars(board: Board) -> list[tuple[float, float, float, float]]:
    """Black bars as (left, top, width, height) in mm on the paper: runs of cells along rows."""
    cell = board.square_mm / CELLS_OF_SQUARE
    black = board.cells()
    left, top = ((paper - count * cell) / 2 for paper, count in zip(board.paper_mm, black.shape[::-1], strict=True))
    edges = np.diff(np.pad(black, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    bars = []
    for row, line in enumerate(edges):
        for first, last in zip(np.nonzero(line > 0)[0], np.nonzero(line < 0)[0], strict=True):
            bars.append((left + first * cell, top + row * cell, (last - first) * cell, cell))
    return bars


def _caption(board: Board) -> str:
    return f"panoless board: print at 100 %; five squares measure {5 * board.square_mm:g} mm"


def _write_svg(board: Board, path: Path) -> None:
    width, height = board.paper_mm
    bars = "".join(f'<path d="M{x:.3f} {y:.3f}h{w:.3f}v{h:.3f}h-{w:.3f}z"/>' for x, y, w, h in _bars(board))
    text = f'<text x="{width / 2}" y="{height - 5}" font-size="3" text-anchor="middle">{_caption(board)}</text>'
    size = f'width="{width}mm" height="{height}mm" viewBox="0 0 {width} {height}"'
    write_text(
        path, f'<svg xmlns="http://www.w3.org/2000/svg" {size} shape-rendering="crispEdges">{bars}{text}</svg>\n'
    )


def _write_pdf(board: Board, path: Path) -> None:
    """One page of filled rectangles and a line of text (PDF 1.4, ISO 32000-1)."""
    width, height = board.paper_mm
    scale = f"{POINTS_PER_MM:.6f} 0 0 {POINTS_PER_MM:.6f} 0 0 cm"
    bars = "\n".join(f"{x:.3f} {height - y - h:.3f} {w:.3f} {h:.3f} re" for x, y, w, h in _bars(board))
    text = f"BT /F 3 Tf {width / 2 - 50:.1f} 5 Td ({_caption(board)}) Tj ET"
    content = f"q {scale}\n{bars}\nf\n{text}\nQ"
    box = f"[0 0 {width * POINTS_PER_MM:.3f} {height * POINTS_PER_MM:.3f}]"
    font = "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>"
    objects = [
        "<< /Type /Catalog /Pages 2 0 R >>",
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents 4 0 R /Resources << /Font << /F {font} >> >> >>",
        f"<< /Length {len(content)} >>\nstream\n{content}\nendstream",
    ]
    file, offsets = "%PDF-1.4\n", []
    for number, entry in enumerate(objects, 1):
        offsets.append(len(file))
        file += f"{number} 0 obj\n{entry}\nendobj\n"
    places = "".join(f"{offset:010d} 00000 n \n" for offset in offsets)
    count = len(objects) + 1
    trailer = f"trailer\n<< /Size {count} /Root 1 0 R >>\nstartxref\n{len(file)}\n%%EOF\n"
    file += f"xref\n0 {count}\n0000000000 65535 f \n{places}{trailer}"
    with atomic_write(path) as temporary:
        temporary.write_bytes(file.encode("ascii"))


def recognized_board(frames: Frames, folder: Path) -> Board | None:
    """The board of which most corners are seen, if half of some frames show enough of them; None: there is none.

    A board on Letter is found as one on A4: that has all of its markers in the same places and one row more, so their
    world is the same.
    """
    photographs = frames.photographs
    some = replace(frames, photographs=photographs[:: -(-len(photographs) // BOARD_FRAMES)])
    best, most = None, 0
    for board in (BOARDS["A4"], BOARDS["A3"]):
        seen = [len(each.corners) for each in find_board(board, some, folder)]
        enough = [count for count in seen if count >= LEAST_CORNERS]
        if 2 * len(enough) >= len(some.photographs) and sum(enough) > most:
            best, most = board, sum(enough)
    return best


def find_board(board: Board, frames: Frames, folder: Path) -> list[Sighting]:
    """The frames that show corners enough for a pose, not all on one line."""
    cv2 = opencv()
    parameters = cv2.aruco.CharucoParameters()
    parameters.minMarkers = 1  # The object hides markers; corners that are found wrong are outliers.
    detector = cv2.aruco.CharucoDetector(drawn_by_opencv(board), parameters)
    sightings = []
    for photograph in frames.photographs:
        gray = cv2.cvtColor(read_png(folder / f"{photograph.name}.png")[..., :3].copy(), cv2.COLOR_RGB2GRAY)
        places, corners, _, _ = detector.detectBoard(gray)
        if corners is None or len(corners) < CORNERS_OF_POSE:
            continue
        numbers = corners[:, 0]
        columns, rows = numbers % (board.columns - 1), numbers // (board.columns - 1)
        if np.linalg.matrix_rank(np.stack([columns, rows, np.ones_like(rows)]).astype(float)) == 3:
            sightings.append(Sighting(photograph.name, numbers.astype(np.int64), places[:, 0].astype(np.float64)))
    return sightings


def poses_from_board(
    board: Board,
    frames: Frames,
    folder: Path,
    *,
    corner_blurs_px: Sequence[float] = CORNER_BLURS_PX,
) -> Poses:
    """Poses, one focal length and k1 by least squares over all corners (Zhang 2000); the world is the board's, in m.

    The origin is the board's corner, +z out of the paper. Raises InputError for pictures of several sizes, and where
    the focal length remains uncertain.
    """
    cv2 = opencv()
    sizes = {(photograph.width, photograph.height) for photograph in frames.photographs}
    if len(sizes) > 1:
        raise InputError(
            expected="photographs of one size and one lens, for a board",
            found=", ".join(f"{width}×{height}" for width, height in sorted(sizes)),
            remedy="Keep the zoom and the crop the same, and hold the camera the same way up.",
        )
    size = sizes.pop()
    seen = find_board(board, frames, folder)
    sightings = [sighting for sighting in seen if len(sighting.corners) >= LEAST_CORNERS]
    origin = f"the board of {board.columns}×{board.rows} squares"
    if len(sightings) < LEAST_VIEWS:
        raise InputError(
            expected=f"at least {LEAST_VIEWS} frames that show {LEAST_CORNERS} corners of {origin}",
            found=f"{len(sightings)} of {len(frames.photographs)}",
            remedy="Let the whole board be in the picture, flat, sharp and larger than the object; check --board.",
        )
    start = cv2.initCameraMatrix2D(*_points_and_places(board, sightings), size, 1.0)[0, 0]
    lens = Lens(float(start), float(start), size[0] / 2, size[1] / 2, *size)
    sightings, adjusted = _robust(board, sightings, lens, OUTLIER_ROUNDS)
    pictures = {one.name: folder / f"{one.name}.png" for one in frames.photographs}
    for blur_px in corner_blurs_px:
        known = dict(zip((sighting.name for sighting in sightings), adjusted.poses, strict=True))
        near = {
            sighting.name: known.get(sighting.name, _rough_pose(board, sighting, adjusted.lens)) for sighting in seen
        }
        located = _located(board, near, adjusted.lens, pictures, blur_px)
        if len(located) < LEAST_VIEWS:
            break
        sightings, adjusted = _robust(board, located, adjusted.lens, 1)
    if not adjusted.focal_error < MOST_FOCAL_ERROR:
        raise InputError(
            expected=f"frames that determine the focal length to {MOST_FOCAL_ERROR:.0%}",
            found=f"an uncertainty of {adjusted.focal_error:.1%}",
            remedy="Add frames that see the board at a slant, from different sides.",
        )
    views, seen_points, corners = [], [], corners_of(board) @ BOARD_TO_WORLD[:3, :3]
    for sighting, pose, residuals in zip(sightings, adjusted.poses, adjusted.residuals_px, strict=True):
        in_world = BOARD_TO_WORLD @ pose
        error = float(np.sqrt((residuals**2).mean()))
        views.append(PosedView(sighting.name, adjusted.lens, as_rows(in_world), error))
        points = corners[sighting.corners]
        seen_points.append(SeenPoints(adjusted.lens, in_world, sighting.corners, points, sighting.places_px))
    poses = Poses(origin, "m", tuple(views), focal_error=adjusted.focal_error, ground=LEVEL)
    return with_covariances(poses, seen_points, known_points=True)


@dataclass(frozen=True)
class _Adjusted:
    """Lens and poses, camera to board, with least squared residuals, and how far off each corner is."""

    lens: Lens
    focal_error: float
    poses: tuple[Float[np.ndarray, "4 4"], ...]
    residuals_px: tuple[Float[np.ndarray, "_"], ...]


def _points_and_places(board: Board, sightings: list[Sighting]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Corners in meters on the board and in pixels, as OpenCV takes them."""
    points = corners_of(board).astype(np.float32)
    places = [sighting.places_px.astype(np.float32) for sighting in sightings]
    return [points[sighting.corners] for sighting in sightings], places


def _adjust(board: Board, sightings: list[Sighting], lens: Lens) -> _Adjusted:
    """One focal length, k1 and all poses at once, from a lens to start with."""
    cv2 = opencv()
    points, places = _points_and_places(board, sightings)
    flags = cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST
    flags |= cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS
    size = (lens.width, lens.height)
    _, matrix, distortion, turns, shifts, deviations, _, _ = cv2.calibrateCameraExtended(
        points, places, size, lens.matrix, np.zeros(5), flags=flags
    )
    poses, residuals = [], []
    for known, found, turn, shift in zip(points, places, turns, shifts, strict=True):
        seen = cv2.projectPoints(known, turn, shift, matrix, distortion)[0][:, 0]
        residuals.append(np.linalg.norm(seen - found, axis=1).astype(np.float64))
        poses.append(_camera_to_board(turn, shift))
    focal, k1 = float(matrix[0, 0]), float(distortion.ravel()[0])
    found_lens = Lens(focal, focal, lens.cx, lens.cy, *size, k1=k1)
    # The deviation stands at one of fx and fy, which are the same.
    return _Adjusted(found_lens, float(deviations[:2].max()) / focal, tuple(poses), tuple(residuals))


def _robust(board: Board, sightings: list[Sighting], lens: Lens, rounds: int) -> tuple[list[Sighting], _Adjusted]:
    """The adjustment of what is left when outliers are gone."""
    adjusted = _adjust(board, sightings, lens)
    for _ in range(rounds):
        sightings = _without_outliers(sightings, adjusted.residuals_px)
        adjusted = _adjust(board, sightings, lens)
    return sightings, adjusted


def _rough_pose(board: Board, sighting: Sighting, lens: Lens) -> Float[np.ndarray, "4 4"]:
    """Camera to board, of one frame by itself under a lens that is known."""
    cv2 = opencv()
    points, places = _points_and_places(board, [sighting])
    _, turn, shift = cv2.solvePnP(points[0], places[0], lens.matrix, np.array(lens.distortion), flags=cv2.SOLVEPNP_IPPE)
    return _camera_to_board(turn, shift)


def _camera_to_board(turn: Float[np.ndarray, "3 1"], shift: Float[np.ndarray, "3 1"]) -> Float[np.ndarray, "4 4"]:
    """The pose that OpenCV has as the board's rotation vector and place before the camera."""
    board_to_camera = np.eye(4)
    board_to_camera[:3, :3], board_to_camera[:3, 3] = opencv().Rodrigues(turn)[0], shift.ravel()
    return np.linalg.inv(board_to_camera)


def _located(
    board: Board,
    poses: dict[str, Float[np.ndarray, "4 4"]],
    lens: Lens,
    pictures: dict[str, Path],
    blur_px: float,
) -> list[Sighting]:
    """The corners by all of the print around them, near where poses have them, in the frames that show enough."""
    found = []
    for name, pose in poses.items():
        light = luminance(read_png(pictures[name])[..., :3])
        located = locate_corners(board, name, light, lens, pose, blur_px)
        if len(located.corners) >= LEAST_CORNERS:
            found.append(located)
    return found


def _without_outliers(sightings: list[Sighting], residuals_px: tuple[Float[np.ndarray, "_"], ...]) -> list[Sighting]:
    """Corners within three deviations, by the median of all; frames that keep enough of them."""
    limit = 3 * 1.4826 * float(np.median(np.concatenate(residuals_px)))
    kept = []
    for sighting, residuals in zip(sightings, residuals_px, strict=True):
        near = residuals <= limit
        if near.sum() >= LEAST_CORNERS:
            kept.append(Sighting(sighting.name, sighting.corners[near], sighting.places_px[near]))
    return kept
