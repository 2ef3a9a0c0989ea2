"""Films as data, and the sheet below their objects."""

import numpy as np
import pytest

from shinypartial.core.board import BOARDS, CELLS_OF_SQUARE
from shinypartial.core.errors import InputError
from shinypartial.core.trajectory import unit_vectors
from shinypartial.scene import DEVELOPMENT, HELD_OUT, Ground, film_names, load_film
from shinypartial.scene.ground import BLACK

SHEET = Ground(height=-0.3, side=1.0, board="A4", radiance=0.8)


def test_films_come_with_the_repository() -> None:
    films = [load_film(name) for name in film_names()]
    assert len(films) == 6
    assert {film.scene.split for film in films if film.photographs is None} == {DEVELOPMENT}
    assert {film.scene.split for film in films if film.photographs} == {DEVELOPMENT, HELD_OUT}
    assert sum(film.scene.ground.board is not None for film in films if film.scene.ground) == 2
    assert all(film.scene.operator and film.scene.room and film.size[1] % 2 == 0 for film in films)


def test_an_unknown_film_is_told(tmp_path) -> None:
    with pytest.raises(InputError, match="sculpture-board"):
        load_film("no-such-film")
    (tmp_path / "film.toml").write_text("[scene]\nname = 1\n")
    with pytest.raises(InputError, match=r"film\.toml"):
        load_film(str(tmp_path / "film.toml"))


def test_points_of_the_board_are_its_cells_and_others_the_pattern() -> None:
    """In the board's own world, which begins at `board_corner`: rows go down along −y."""
    board = BOARDS["A4"]
    side = board.square_mm * 1e-3 / CELLS_OF_SQUARE
    row, column = np.indices(board.cells().shape).reshape(2, -1)
    corner = np.array(SHEET.board_corner)
    points = corner[:2] + side * np.stack([column + 0.5, -row - 0.5], -1)
    expected = np.where(board.cells().ravel(), BLACK, 1.0) * SHEET.radiance
    np.testing.assert_allclose(SHEET.radiance_at(points), np.repeat(expected[:, None], 3, 1), rtol=1e-6)
    beside = np.array([[0.49, -0.49], [-0.49, 0.49]])
    texture = SHEET.texture()
    pixel = round(0.01 * len(texture))
    assert np.abs(SHEET.radiance_at(beside) - [texture[-pixel, -pixel], texture[pixel, pixel]]).max() < 0.8


def test_rays_meet_the_sheet_where_it_is() -> None:
    directions = unit_vectors(np.random.default_rng(0).uniform([-180, -90], [180, 90], (2000, 2)))
    meets, points = SHEET.seen_from_origin(directions)
    np.testing.assert_allclose(points[:, 2], SHEET.height)
    np.testing.assert_allclose(np.cross(points, directions[meets]), 0, atol=1e-12)
    steep = np.degrees(np.arcsin(-directions[:, 2]))
    assert meets[steep > 70].all()  # atan(0.3/0.5·√½) is 23° at the corners, 31° at the sides.
    assert not meets[steep < 22].any()
    assert np.abs(points[:, :2]).max() < SHEET.side / 2
