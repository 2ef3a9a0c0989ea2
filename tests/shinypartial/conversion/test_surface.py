"""The GLB is valid glTF and holds the surface of the PLY; what is no surface is refused."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from shinypartial.cli import main
from shinypartial.conversion.gltf import write_glb
from shinypartial.core.errors import InputError
from shinypartial.prediction.format import PredictionInfo, write_info
from shinypartial.prediction.surface import surface_of, triangles_of
from tests.support.polyhedra import L_SHAPE, spiral, wavy_patch

TINT = (0.9, 0.6, 0.3)


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray | None, normals: np.ndarray | None = None) -> None:
    names = ["x", "y", "z"] + (["nx", "ny", "nz"] if normals is not None else [])
    table = np.zeros(len(vertices), [(name, "<f8") for name in names])
    for name, column in zip(
        names, np.concatenate([vertices, *([] if normals is None else [normals])], 1).T, strict=True
    ):
        table[name] = column
    elements = [PlyElement.describe(table, "vertex")]
    if faces is not None:
        lists = np.zeros(len(faces), [("vertex_indices", "<i4", faces.shape[1:])])
        lists["vertex_indices"] = faces
        elements.append(PlyElement.describe(lists, "face"))
    PlyData(elements).write(str(path))


def prediction(folder: Path, vertices: np.ndarray, faces: np.ndarray | None, normals: np.ndarray | None = None) -> Path:
    folder.mkdir()
    write_ply(folder / "surface.ply", vertices, faces, normals)
    write_info(folder, PredictionInfo("m", "none", "", {}, {}, {}, {}, 0, reflectance=TINT))
    return folder


def read_glb(path: Path) -> tuple[dict, list[np.ndarray]]:
    """Content and accessors by the letter of the specification, which it also checks."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    content = json.loads(data[20 : 20 + size])
    binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    binary = data[28 + size :]
    assert kind == b"BIN\0"
    assert binary_size == len(binary)
    assert binary_size % 4 == 0
    assert content["buffers"][0]["byteLength"] == binary_size
    arrays = []
    for accessor in content["accessors"]:
        view = content["bufferViews"][accessor["bufferView"]]
        number = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        width = {"VEC3": 3, "SCALAR": 1}[accessor["type"]]
        array = np.frombuffer(binary, number, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)
        assert view["byteOffset"] % 4 == 0
        assert array.nbytes == view["byteLength"]
        if "min" in accessor:
            assert accessor["min"] == array.min(0).tolist()
            assert accessor["max"] == array.max(0).tolist()
        arrays.append(array)
    return content, arrays


def test_a_glb_holds_the_surface_with_y_up(tmp_path: Path) -> None:
    vertices, faces, normals = wavy_patch()
    folder = prediction(tmp_path / "p", vertices, faces, normals)
    assert main(["convert", str(folder), "--to", "glb", "--output", str(tmp_path)]) == 0
    content, (positions, found, indices) = read_glb(tmp_path / "surface.glb")
    back = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # Rows: the world directions of x, y and z.
    np.testing.assert_allclose(positions @ back, vertices, atol=1e-6)
    np.testing.assert_allclose(found @ back, normals, atol=1e-6)
    corners = positions[indices.reshape(-1, 3)]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert len(facing) == 2 * len(faces)
    assert ((facing * found[indices.reshape(-1, 3)[:, 0]]).sum(1) > 0).all()
    material = content["materials"][0]["pbrMetallicRoughness"]
    assert material == {"baseColorFactor": [*TINT, 1.0], "metallicFactor": 1.0, "roughnessFactor": 0.0}


@pytest.mark.parametrize("silhouette", [L_SHAPE, spiral()], ids=["L", "spiral"])
def test_a_polygon_is_cut_into_triangles_of_its_area_and_turn(tmp_path: Path, silhouette: np.ndarray) -> None:
    tilt = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    tilt *= np.linalg.det(tilt)
    vertices = np.pad(silhouette, ((0, 0), (0, 1))) @ tilt.T
    surface = surface_of(prediction(tmp_path / "p", vertices, np.arange(len(silhouette))[None]))
    np.testing.assert_allclose(surface.normals, np.broadcast_to(tilt[:, 2], vertices.shape), atol=1e-9)
    corners = silhouette[triangles_of(surface)]
    (x, y), (u, v) = (
        np.moveaxis(corners[:, 1] - corners[:, 0], -1, 0),
        np.moveaxis(corners[:, 2] - corners[:, 0], -1, 0),
    )
    (a, b), (c, d) = silhouette.T, np.roll(silhouette, -1, 0).T
    assert (x * v - y * u > 0).all()
    assert (x * v - y * u).sum() == pytest.approx((a * d - b * c).sum(), rel=1e-9)
    assert len(corners) == len(silhouette) - 2


def test_triangles_without_area_are_left_out(tmp_path: Path) -> None:
    """As at the axis of a surface of revolution, where quadrilaterals have two corners at one place."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0]])
    surface = surface_of(prediction(tmp_path / "p", vertices, np.array([[0, 1, 2, 3]])))
    assert triangles_of(surface).tolist() == [[0, 1, 2]]
    write_glb(tmp_path / "one.glb", surface, (1.0, 1.0, 1.0))
    assert read_glb(tmp_path / "one.glb")[1][2].ravel().tolist() == [0, 1, 2]


def test_a_cloud_is_no_surface(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = prediction(tmp_path / "p", np.eye(3), None)
    assert surface_of(folder) is None
    assert main(["convert", str(folder), "--to", "glb"]) == 2
    assert "cloud of points" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("vertices", "faces", "found"),
    [
        (np.eye(3), [[0, 1, 3]], "faces of other vertices than the 3"),
        (np.diag([1, 1, np.nan]), [[0, 1, 2]], "not finite"),
        (np.eye(3), [[0, 1, 1]], "no face with an area"),
    ],
)
def test_a_surface_that_is_not_whole_is_refused(tmp_path: Path, vertices: np.ndarray, faces: list, found: str) -> None:
    with pytest.raises(InputError, match=rf"a whole surface in .*{found}"):
        surface_of(prediction(tmp_path / "p", vertices, np.array(faces)))


def test_faces_without_vertices_are_refused(tmp_path: Path) -> None:
    lists = np.array([((0, 1, 2),)], [("vertex_indices", "<i4", 3)])
    PlyData([PlyElement.describe(lists, "face")]).write(str(tmp_path / "surface.ply"))
    with pytest.raises(InputError, match="no vertices with x, y and z"):
        surface_of(tmp_path)


def test_two_surfaces_are_one_too_many(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = prediction(tmp_path / "p", np.eye(3), np.array([[0, 1, 2]]))
    write_ply(folder / "another.ply", np.eye(3), None)
    assert main(["convert", str(folder), "--to", "glb"]) == 2
    assert "another.ply, surface.ply" in capsys.readouterr().err
