"""The board as it is printed, and cameras that are found from photographs of it by known ones."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from panoless.photographs import board as board_module
from panoless.photographs import corners
from panoless.photographs.board import (
    BOARD_TO_WORLD,
    drawn_by_opencv,
    poses_from_board,
    recognized_board,
    write_board,
)
from panoless.photographs.corners import corners_of, locate_corners
from panoless.photographs.frames import Frames, Photograph
from panoless.photographs.lens import Lens
from panoless.photographs.video import luminance
from shinypartial.core.board import BOARDS, Board
from shinypartial.core.camera import Camera, project
from shinypartial.core.errors import InputError
from shinypartial.io.images import read_png, write_png
from tests.support.photographed_planes import arc, photograph

BOARD, CELL_PX = BOARDS["A4"], 8
SIZE, DISTANCE_M = (800, 600), 0.6
MM_PX = 4


def painted(bars: list[tuple[float, ...]]) -> np.ndarray:
    """The page with its bars, four pixels a millimeter."""
    width, height = BOARD.paper_mm
    page = np.full((round(height * MM_PX), round(width * MM_PX)), 255, np.uint8)
    for x, y, w, h in bars:
        page[round(y * MM_PX) : round((y + h) * MM_PX), round(x * MM_PX) : round((x + w) * MM_PX)] = 0
    return page


def svg_bars(path: Path) -> list[tuple[float, ...]]:
    return [tuple(map(float, bar)) for bar in re.findall(r"M([\d.]+) ([\d.]+)h([\d.]+)v([\d.]+)h", path.read_text())]


def test_the_printed_page_is_the_board_that_is_looked_for(tmp_path: Path) -> None:
    write_board(BOARD, tmp_path / "board.svg")
    page = painted(svg_bars(tmp_path / "board.svg"))
    places, corners, _, _ = cv2.aruco.CharucoDetector(drawn_by_opencv(BOARD)).detectBoard(page)
    assert len(corners) == (BOARD.columns - 1) * (BOARD.rows - 1)
    steps = np.linalg.norm(np.diff(places[: BOARD.columns - 1, 0], axis=0), axis=1) / MM_PX
    np.testing.assert_allclose(steps, BOARD.square_mm, atol=0.1)  # A tenth of a millimeter: half a pixel.


@pytest.mark.parametrize("paper", BOARDS)
def test_the_cells_are_those_that_opencv_draws(paper: str) -> None:
    cells = BOARDS[paper].cells()
    np.testing.assert_array_equal(cells, drawn_by_opencv(BOARDS[paper]).generateImage(cells.shape[::-1]) < 128)


@pytest.mark.parametrize("paper", BOARDS)
def test_boards_leave_the_margin_that_printers_need(paper: str, tmp_path: Path) -> None:
    board = BOARDS[paper]
    write_board(board, tmp_path / "board.svg")
    bars = np.array(svg_bars(tmp_path / "board.svg"))
    margins = *bars[:, :2].min(0), *(np.array(board.paper_mm) - (bars[:, :2] + bars[:, 2:]).max(0))
    assert min(margins) >= 8


def test_pdf_and_svg_have_the_same_bars_and_the_pdf_its_offsets(tmp_path: Path) -> None:
    write_board(BOARD, tmp_path / "board.svg")
    write_board(BOARD, tmp_path / "board.pdf")
    content = (tmp_path / "board.pdf").read_bytes()
    found = [tuple(map(float, bar)) for bar in re.findall(rb"([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re", content)]
    height = BOARD.paper_mm[1]
    np.testing.assert_allclose(
        [(x, height - y - h, w, h) for x, y, w, h in found], svg_bars(tmp_path / "board.svg"), atol=2e-3
    )
    for number, offset in enumerate(re.findall(rb"(\d{10}) 00000 n", content), 1):
        assert content[int(offset) :].startswith(b"%d 0 obj" % number)
    assert content[int(re.findall(rb"startxref\n(\d+)", content)[0]) :].startswith(b"xref")


def test_another_kind_of_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.pdf or \.svg"):
        write_board(BOARD, tmp_path / "board.png")


def photographs_of(board: Board, folder: Path, distance_m: float) -> tuple[Frames, list[Camera]]:
    """Nine photographs of a board in a folder, and the cameras that took them."""
    picture = np.where(np.kron(board.cells(), np.ones((CELL_PX, CELL_PX), bool)), 20, 235).astype(np.uint8)
    (width, height), corners = board.size_m, board.corners_world()
    cameras = arc(9, distance_m, SIZE, 900.0, (width / 2, -height / 2, 0.0))
    frames = []
    for index, camera in enumerate(cameras):
        path = folder / f"board_{index}.png"
        write_png(path, np.repeat(photograph(camera, [(picture, corners)])[..., None], 3, 2))
        frames.append(Photograph(path.stem, path, *SIZE, 1, *SIZE, blur=0.0, brightness=0.5))
    return Frames(tuple(frames)), cameras


@pytest.fixture(scope="module")
def photographed(tmp_path_factory: pytest.TempPathFactory):
    """A folder of photographs of the board on A4, their frames, and the cameras that took them."""
    folder = tmp_path_factory.mktemp("board")
    return folder, *photographs_of(BOARD, folder, DISTANCE_M)


@pytest.mark.parametrize(("paper", "found"), [("A4", "A4"), ("Letter", "A4"), ("A3", "A3")])
def test_a_board_is_known_by_its_markers(paper: str, found: str, tmp_path: Path) -> None:
    """Letter is A4 without its last row, so both define one world. Where most frames show none, there is none."""
    frames, _ = photographs_of(BOARDS[paper], tmp_path, 0.9)
    assert recognized_board(frames, tmp_path) == BOARDS[found]
    gray = np.full((*SIZE[::-1], 3), 90, np.uint8)
    for one in frames.photographs[:6]:
        write_png(tmp_path / f"{one.name}.png", gray)
    assert recognized_board(frames, tmp_path) is None


def test_cameras_are_found_from_the_board(photographed) -> None:
    """Poses within 0.03°, distances within 0.1 %: 0.012° and 0.04 % were measured; a pixel is 0.06°."""
    folder, frames, cameras = photographed
    found = poses_from_board(BOARD, frames, folder)
    assert [view.name for view in found.views] == [one.name for one in frames.photographs]
    for view, camera in zip(found.views, cameras, strict=True):
        pose = np.array(view.camera_to_world)
        turn = pose[:3, :3].T @ camera.camera_to_world[:3, :3]
        assert np.degrees(np.linalg.norm(cv2.Rodrigues(turn)[0])) < 0.03
        assert np.linalg.norm(pose[:3, 3] - camera.position_world) < 0.001 * DISTANCE_M
    assert found.unit == "m"
    assert found.views[0].lens.fx == pytest.approx(900, rel=0.002)
    assert abs(found.views[0].lens.fx / 900 - 1) < 4 * found.focal_error + 1e-3


def test_corners_are_found_by_all_print_around_them_and_not_where_something_hides_it(photographed) -> None:
    """From a pose that is wrong by 0.05°, 0.8 px, one step leaves a tenth: within 0.15 px, 0.08 px were measured."""
    folder, frames, cameras = photographed
    camera = cameras[4]
    lens = Lens(camera.fx, camera.fy, camera.cx, camera.cy, *SIZE)
    true_pose = np.linalg.inv(BOARD_TO_WORLD) @ camera.camera_to_world
    points = project(camera, corners_of(BOARD) * [1, -1, -1])[:, :2] - 0.5
    wrong = true_pose.copy()
    wrong[:3, :3] = true_pose[:3, :3] @ cv2.Rodrigues(np.radians([0.035, -0.035, 0.0]))[0]
    light = luminance(read_png(folder / f"{frames.photographs[4].name}.png"))
    hidden = slice(270, 330), slice(370, 430)
    light[hidden] = 0.5
    found = locate_corners(BOARD, "4", light, lens, wrong, 1.5)
    assert len(found.corners) > 0.7 * len(points)
    assert np.abs(found.places_px - points[found.corners]).max() < 0.15
    behind = ((points > [375, 275]) & (points < [425, 325])).all(1)
    assert behind.any()
    assert not set(np.flatnonzero(behind)) & set(found.corners)


def test_the_measured_square_scales_the_world(photographed) -> None:
    folder, frames, cameras = photographed
    board = replace(BOARD, square_mm=2 * BOARD.square_mm)
    found = poses_from_board(board, frames, folder, corner_blurs_px=())
    position = np.array(found.views[0].camera_to_world)[:3, 3]
    np.testing.assert_allclose(position, 2 * cameras[0].position_world, atol=0.004 * DISTANCE_M)


def test_corners_that_no_print_explains_stay_as_they_were_detected(
    photographed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No window has all of its variance explained: a refinement that keeps too few frames changes nothing."""
    folder, frames, _ = photographed
    detected = poses_from_board(BOARD, frames, folder, corner_blurs_px=())
    monkeypatch.setattr(corners, "LEAST_MATCH", 1.0)
    assert poses_from_board(BOARD, frames, folder) == detected


def test_a_board_that_is_hardly_seen_is_refused(photographed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, frames, _ = photographed
    for one in frames.photographs:
        image = read_png(folder / f"{one.name}.png").copy()
        image[:, : SIZE[0] // 2 + 60] = 90
        image[: SIZE[1] // 2] = 90
        write_png(tmp_path / f"{one.name}.png", image)
    monkeypatch.setattr(board_module, "LEAST_CORNERS", 15)
    with pytest.raises(InputError, match="whole board"):
        poses_from_board(BOARD, frames, tmp_path)


def test_another_size_among_the_frames_is_refused(photographed) -> None:
    folder, frames, _ = photographed
    turned = replace(frames.photographs[0], width=SIZE[1], height=SIZE[0])
    with pytest.raises(InputError, match="one size"):
        poses_from_board(BOARD, Frames((turned, *frames.photographs[1:])), folder)
