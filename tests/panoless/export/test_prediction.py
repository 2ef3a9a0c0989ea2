"""What a fit leaves behind: a prediction that the evaluator reads, a PLY in world units, and renders that are right."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from panoless.capture.corrections import Corrections
from panoless.capture.object_frame import ObjectFrame
from panoless.capture.poses import Poses, moved_view
from panoless.capture.rays import pose_of, raster_camera
from panoless.capture.views import TrainView
from panoless.environment.surroundings import Floor, Surroundings
from panoless.export.mesh_files import write_ply
from panoless.export.pictures import environment_picture, object_window
from panoless.export.prediction import PICTURES, cube_to_latlong, export_prediction, is_exported, viewpoint_of
from panoless.export.render import render
from panoless.geometry.base import Geometry
from panoless.geometry.height_field.kind import HeightFieldMirror
from panoless.geometry.plane.kind import PlaneMirror
from panoless.geometry.revolution.kind import RevolutionMirror
from panoless.geometry.revolution.model import SurfaceOfRevolution
from panoless.kernels.cubemap import cubemap_directions
from panoless.reconstruct.state import FitState
from panoless.selection.candidates import Candidate, Selection, Verdict
from panoless.splats.mirror import SurfelMirror
from shinypartial.core.color import to_display
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import cube_to_latlong as clamped_cube_to_latlong
from shinypartial.core.sphere import directions_to_cube, latlong_directions
from shinypartial.dataset.read import open_dataset, read_view
from shinypartial.dataset.schema import Dataset
from shinypartial.evaluation.evaluate import evaluate
from shinypartial.io.picture_sheet import MAX_BYTES, TILE_PX, TITLE_PX
from shinypartial.prediction.format import (
    DECOMPOSITION,
    ENVIRONMENT_PICTURE,
    acquire_prediction,
    dataset_hash,
    prediction_frame,
    read_environment_map,
    read_info,
    read_visibility,
)
from tests.panoless.conftest import FinishedFit
from tests.support.mirror_height_field import bumpy
from tests.support.mirror_plane import L_SHAPE, RECTANGLE, make_plane_dataset, plane_of
from tests.support.mirror_sphere import clipped_environment, sphere_surfels, tiny_config
from tests.support.synthetic_dataset import render_sphere, sphere_cameras

UNIT_FRAME = ObjectFrame(np.zeros(3), 1.0)


@pytest.fixture(scope="module")
def prediction(finished: FinishedFit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("predictions") / "sphere"
    acquire_prediction(folder)
    export_prediction(finished.dataset, finished.state, finished.config, folder)
    return folder


def test_the_readers_accept_the_prediction(prediction: Path, finished: FinishedFit) -> None:
    info = read_info(prediction)
    assert info.dataset_hash == dataset_hash(finished.dataset)
    assert info.config["splats"]["surfels"]["count"] == finished.config.splats.surfels.count
    assert info.primitives == finished.state.geometry.num_primitives
    files = (prediction / "surfels.ply", prediction / "environment.exr")
    assert info.model_bytes == sum(path.stat().st_size for path in files)
    assert info.iteration is None
    assert sum(info.parameter_counts.values()) == 13 * finished.config.splats.surfels.count + 6 * 3 * 24 * 24
    assert info.peak_memory_bytes > 1e7
    assert set(info.seconds) >= {"read views", "initialize", "optimize", "solve environment"}
    assert all(len(series) == len(info.curves["iteration"]) for series in info.curves.values())
    environment, visibility = read_environment_map(prediction), read_visibility(prediction)
    assert visibility is not None
    assert environment.shape[:2] == visibility.shape == (48, 96)
    assert 0.0 <= visibility.min() < visibility.max() <= 1.0
    for frame in finished.dataset.test:
        view = read_view(prediction_frame(prediction, frame))
        assert view.normals_world is not None
        lengths = np.linalg.norm(view.normals_world, axis=-1)
        np.testing.assert_allclose(lengths[view.alpha > 0.01], 1, atol=1e-5)


def test_the_written_visibility_is_that_of_the_fit(prediction: Path, finished: FinishedFit) -> None:
    visibility, written = finished.state.visibility, read_visibility(prediction)
    assert visibility is not None
    assert written is not None
    np.testing.assert_allclose(written, cube_to_latlong(visibility[:, None], 48)[..., 0], atol=1e-6)


def test_the_evaluator_scores_it(prediction: Path, finished: FinishedFit) -> None:
    scores = evaluate(prediction, finished.dataset.root, protocol="linear-v1")
    assert (prediction / "scores.json").exists()
    # Far below what a second of fitting reaches (3°, 25 dB), far above what a wrong axis leaves.
    assert scores.normals is not None
    assert scores.normals.median_angular_error_deg < 6.0


def test_pictures_of_the_decomposition_are_there(prediction: Path) -> None:
    names = [path.name for path in sorted((prediction / PICTURES).iterdir())]
    assert [name[0] for name in names] == list("123456")


def tiles_of(sheet: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Photograph, environment, normals and visibility of the picture that sums up a prediction."""
    with Image.open(sheet) as opened:
        picture = np.asarray(opened).astype(float)
    lower, upper = picture[TILE_PX + 2 * TITLE_PX :], picture[TITLE_PX : TITLE_PX + TILE_PX]
    return upper[:, :TILE_PX], upper[:, TILE_PX:], lower[:, :TILE_PX], lower[:, TILE_PX:]


def test_one_picture_shows_photograph_normals_environment_and_visibility(
    tmp_path: Path, prediction: Path, finished: FinishedFit
) -> None:
    """They are those of the files, in a training view; photographs of one's own have no test views."""
    export_prediction(replace(finished.dataset, test=()), finished.state, finished.config, tmp_path)
    assert (tmp_path / DECOMPOSITION).read_bytes() == (prediction / DECOMPOSITION).read_bytes()
    assert (tmp_path / DECOMPOSITION).stat().st_size < MAX_BYTES
    photograph, environment, normals, visibility = tiles_of(tmp_path / DECOMPOSITION)
    truth = read_view(finished.dataset.train[len(finished.dataset.train) // 2])
    assert truth.normals_world is not None
    window = object_window(truth.alpha)
    known = read_visibility(tmp_path)
    assert known is not None
    with Image.open(tmp_path / ENVIRONMENT_PICTURE) as opened:
        picture = np.asarray(opened)
    expected = (
        (photograph, to_display(truth.radiance)[window], 3.0),
        # A second of fitting leaves normals wrong by 3°, and surfels reach over the silhouette.
        (normals, 127.5 * (truth.normals_world + 1)[window] * (truth.alpha[window] > 0.5)[..., None], 12.0),
        (environment, picture, 3.0),
        (visibility, np.repeat(255 * known[..., None], 3, 2), 3.0),
    )
    for tile, whole, tolerance in expected:
        size = tile.shape[1], tile.shape[0]
        enlarged = Image.fromarray(whole.astype(np.uint8)).resize(size, Image.Resampling.BICUBIC)
        assert np.abs(tile - np.asarray(enlarged)).mean() < tolerance


def test_what_no_view_saw_is_hatched_in_the_picture_of_the_environment() -> None:
    environment, visibility = np.full((512, 1024, 3), (0.9, 0.1, 0.2)), np.ones((512, 1024))
    visibility[:, 640:] = 0
    picture = environment_picture(environment, visibility)
    assert (picture[:, :640] == to_display(environment[0, 0])).all()
    gray = picture[:, 640:]
    assert (gray == gray[..., :1]).all()
    assert len(np.unique(gray[0])) == 2


def test_normals_of_the_picture_are_in_the_camera_that_was_found(tmp_path: Path) -> None:
    """A wrong camera whose error the fit found shows what the right one shows."""
    plane, frame, rng = plane_of(RECTANGLE), ObjectFrame(np.zeros(3), 2.0), np.random.default_rng(3)
    dataset = make_plane_dataset(tmp_path / "plane", plane, train=3)
    poses = Poses(*rng.normal(size=(2, 3, 3)) * 0.1)
    wrong = []
    for index, stated in enumerate(dataset.train):
        pose = stated.camera.camera_to_world.copy()
        pose[:3, :3] = Rotation.from_rotvec(-poses.turns[index]).as_matrix() @ pose[:3, :3]
        pose[:3, 3] -= 2 * poses.shifts[index]
        wrong.append(replace(stated, camera=replace(stated.camera, camera_to_world=pose)))
    chosen = Candidate("plane", Verdict.CHOSEN, "it fits")
    for name, train, found in (("right", dataset.train, None), ("found", tuple(wrong), poses)):
        state = finished_state(PlaneMirror(plane, poses=found), frame, chosen)
        export_prediction(replace(dataset, train=train), state, tiny_config(), tmp_path / name)
    right, found_too = (tiles_of(tmp_path / name / DECOMPOSITION)[2] for name in ("right", "found"))
    assert right.std() > 10
    np.testing.assert_allclose(found_too, right, atol=16)  # A pixel of the edge may be rounded otherwise.


def test_the_window_shows_the_object_and_not_the_empty_picture() -> None:
    """Pictures are cut to where there is alpha, whatever surrounds it; nothing at all is shown whole."""
    alpha = np.zeros((80, 60), np.float32)
    alpha[30:42, 5:17] = 1.0
    assert alpha[object_window(alpha)].shape == (14, 14)
    assert alpha[object_window(alpha)].sum() == 144
    assert alpha[object_window(0 * alpha)].shape == (80, 60)


def test_nothing_half_written_stays(prediction: Path) -> None:
    assert not list(prediction.rglob(".partial-*"))


def test_an_export_that_fails_claims_nothing(tmp_path: Path, finished: FinishedFit, monkeypatch) -> None:
    """An old prediction.json must not describe half of a new prediction, and the next export may take the folder."""
    acquire_prediction(tmp_path)
    export_prediction(finished.dataset, finished.state, finished.config, tmp_path)
    with monkeypatch.context() as patch:

        def fail(*_) -> None:
            raise OSError(28, "No space left on device")

        patch.setattr("panoless.export.prediction.write_ply", fail)
        with pytest.raises(OSError, match="No space"):
            export_prediction(finished.dataset, finished.state, finished.config, tmp_path)
    with pytest.raises(InputError):
        read_info(tmp_path)
    acquire_prediction(tmp_path)
    export_prediction(finished.dataset, finished.state, finished.config, tmp_path)
    read_info(tmp_path)


def test_a_whole_prediction_is_not_made_again(tmp_path: Path, finished: FinishedFit) -> None:
    """Of this fit, with all of its files."""
    dataset, state, config = finished.dataset, finished.state, finished.config
    assert not is_exported(tmp_path, state, config, dataset)
    export_prediction(dataset, state, config, tmp_path)
    assert is_exported(tmp_path, state, config, dataset)
    other = replace(state, seconds={**state.seconds, "optimize": 1e3})
    assert not is_exported(tmp_path, other, config, dataset)
    assert not is_exported(tmp_path, state, replace(config, seed=config.seed + 1), dataset)
    (tmp_path / "test/r_000.exr").unlink()
    assert not is_exported(tmp_path, state, config, dataset)
    (tmp_path / "prediction.json").write_text("{")
    export_prediction(dataset, state, config, tmp_path)
    assert is_exported(tmp_path, state, config, dataset)


def test_nothing_of_another_fit_stays(tmp_path: Path, finished: FinishedFit) -> None:
    """Snapshots, pictures, test views and scores; those of the same fit stay, but for the scores."""
    dataset, state, config = finished.dataset, finished.state, finished.config
    export_prediction(dataset, state, config, tmp_path)
    snapshot, view, scores = (tmp_path / each for each in ("snapshots/000001/x", "test/r_999.exr", "scores.json"))
    snapshot.parent.mkdir(parents=True)
    for path in (snapshot, view, scores):
        path.touch()
    export_prediction(dataset, state, config, tmp_path)
    assert [path.exists() for path in (snapshot, view, scores)] == [True, True, False]
    export_prediction(dataset, replace(state, seconds={"optimize": 1e3}), config, tmp_path)
    assert [path.exists() for path in (snapshot, view)] == [False, False]


def test_an_export_killed_at_its_first_file_may_be_repeated(tmp_path: Path, finished: FinishedFit, monkeypatch) -> None:
    folder = tmp_path / "prediction"
    acquire_prediction(folder)
    with monkeypatch.context() as patch:

        def killed(*_) -> None:
            (folder / ".partial-x.exr").touch()
            raise KeyboardInterrupt

        patch.setattr("panoless.export.prediction.write_visibility", killed)
        with pytest.raises(KeyboardInterrupt):
            export_prediction(finished.dataset, finished.state, finished.config, folder)
    acquire_prediction(folder)
    export_prediction(finished.dataset, finished.state, finished.config, folder)
    assert not list(folder.rglob(".partial-*"))


def read_ply(path: Path) -> dict[str, np.ndarray]:
    """The vertices' columns, and the faces' indices where there are faces."""
    content = PlyData.read(str(path))
    vertices = content["vertex"].data
    table = {name: np.asarray(vertices[name]) for name in vertices.dtype.names}
    if "face" in content:
        table["faces"] = np.stack(list(content["face"]["vertex_indices"]))
    return table


def vertices_of(table: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([table[name] for name in "xyz"], 1)


def test_the_ply_holds_the_surfels_in_world_units(tmp_path: Path) -> None:
    radius, center = 2.0, np.array([10.0, -20.0, 30.0])
    write_ply(tmp_path / "s.ply", SurfelMirror(sphere_surfels(50)).mesh(ObjectFrame(center, radius)))
    table = read_ply(tmp_path / "s.ply")
    points = np.stack([table[name] for name in "xyz"], 1)
    normals = np.stack([table[name] for name in ("nx", "ny", "nz")], 1)
    np.testing.assert_allclose(points, center + radius * normals, atol=1e-5)
    np.testing.assert_allclose(np.exp(table["scale_0"]), radius * sphere_surfels(50).scales[:, 0], rtol=1e-5)
    # A sphere of radius 2 has the curvature −1/2.
    np.testing.assert_allclose(table["curvature_a"], -0.5, rtol=1e-6)
    w, x, y, z = (table[f"rot_{i}"] for i in range(4))
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1)
    np.testing.assert_allclose(axis, normals, atol=1e-6)
    # Black albedo as the degree-0 harmonic that viewers turn into color: 0.5 + 0.2821 f.
    np.testing.assert_allclose(0.5 + 0.28209479 * table["f_dc_0"], 0.0, atol=1e-6)


def test_the_exported_ply_lies_on_the_sphere(prediction: Path, finished: FinishedFit) -> None:
    table = read_ply(prediction / "surfels.ply")
    assert len(table["x"]) == finished.state.geometry.num_primitives
    points = np.stack([table[name] for name in "xyz"], 1)
    front = points[:, 0] > 0.5
    assert abs(np.median(np.linalg.norm(points[front], axis=1)) - 1) < 0.05


def test_a_map_colored_by_direction_shows_each_direction() -> None:
    cube = cubemap_directions(64).permute(0, 3, 1, 2).contiguous()
    # Area averages shorten by 0.1 %; bilinear lookups at 64 texels err by 0.03 %, more at corners.
    np.testing.assert_allclose(cube_to_latlong(cube, 64), latlong_directions(64), atol=3e-3)


def test_a_lat_long_map_has_no_seam_where_faces_meet() -> None:
    """The error of resampling a smooth map jumps over an edge of the cube no more than it does within a face.

    A lookup that stops at the border of a face does jump there: 2.3 times as far, measured on the second map.
    """
    directions, faces = latlong_directions(48), directions_to_cube(latlong_directions(48))[0]
    across = faces[:, 1:] != faces[:, :-1]

    def worst_jump(values: np.ndarray) -> tuple[float, float]:
        jumps = np.abs(np.diff(values - np.sin(3 * directions), axis=1)).max(-1)
        return float(jumps[across].max()), float(jumps[~across].max())

    cube = torch.sin(3 * cubemap_directions(24))
    over_edges, within = worst_jump(cube_to_latlong(cube.permute(0, 3, 1, 2).contiguous(), 48))
    assert over_edges <= 1.5 * within
    seam, smooth = worst_jump(clamped_cube_to_latlong(cube.numpy(), 48))
    assert seam > 2 * smooth


def test_a_lat_long_texel_is_the_mean_of_what_it_covers() -> None:
    cube = torch.rand(6, 2, 4, 4)
    fine, coarse = cube_to_latlong(cube, 64), cube_to_latlong(cube, 32)
    blocks = fine.reshape(32, 2, 64, 2, 2).mean((1, 3))
    # Four against sixteen samples of a piecewise bilinear function.
    np.testing.assert_allclose(coarse, blocks, atol=0.03)


@pytest.mark.parametrize("scale", [1.0, 30.0])
def test_a_rendered_mirror_sphere_is_the_traced_one(scale: float) -> None:
    """Exact surfels and the exact environment give the picture that ray tracing gives, in a world of any size."""
    environment = clipped_environment(cubemap_directions(128)).permute(0, 3, 1, 2).contiguous()
    camera = sphere_cameras("test", 1, 64)[0]
    truth = render_sphere(camera)
    pose = camera.camera_to_world.copy()
    pose[:3, 3] *= scale
    frame = ObjectFrame(np.zeros(3), scale)
    raster = raster_camera(replace(camera, camera_to_world=pose), frame, 0.3)
    parts = render(SurfelMirror(sphere_surfels(1500)), environment, raster, frame, tiny_config())
    # Blended Gaussians reach beyond a silhouette by their radius and bend its normals, so the rim is left out.
    cosine = np.abs((truth.normals_world * (camera.position_world / 4.0)).sum(-1))
    inner = (truth.alpha > 0.99) & (cosine > 0.6)
    assert inner.mean() > 0.3
    assert parts.alpha.numpy()[inner].min() > 0.99
    angles = np.degrees(
        np.arccos((parts.normals_world.permute(1, 2, 0).numpy() * truth.normals_world).sum(-1).clip(-1, 1))
    )
    # Measured with disks of radius 0.07: at most 1.0°, 0.031 in depth, 0.0033 in mean radiance.
    assert angles[inner].max() < 2.0
    np.testing.assert_allclose(parts.depth.numpy()[inner], scale * truth.depth[inner], atol=0.06 * scale)
    difference = np.abs(parts.radiance.permute(1, 2, 0).numpy() - truth.radiance.clip(0, 1))
    assert difference[inner].mean() < 0.01


def test_only_a_finished_fit_is_exported(tmp_path: Path, finished: FinishedFit) -> None:
    unfinished = replace(finished.state, environment=None)
    with pytest.raises(ValueError, match="finished"):
        export_prediction(finished.dataset, unfinished, finished.config, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_the_info_is_strict_json(prediction: Path) -> None:
    json.loads((prediction / "prediction.json").read_text(), parse_constant=lambda name: pytest.fail(name))


def finished_state(geometry: Geometry, frame: ObjectFrame, candidate: Candidate) -> FitState:
    """A state of an exact geometry in the known environment."""
    environment = clipped_environment(cubemap_directions(64)).permute(0, 3, 1, 2).contiguous()
    selection = Selection(geometry.kind, (candidate,))
    return FitState(geometry, frame, selection, environment=environment, visibility=torch.ones(6, 64, 64))


def test_found_cameras_and_exposures_are_in_world_units(tmp_path: Path) -> None:
    """Cameras of a dataset that are turned and shifted as stated are those that the fit ended with."""
    plane, frame = plane_of(RECTANGLE), ObjectFrame(np.zeros(3), 2.0)
    dataset, rng = make_plane_dataset(tmp_path / "plane", plane, train=3), np.random.default_rng(5)
    poses = Poses(*rng.normal(size=(2, 3, 3)) * 0.1, rng.uniform(size=(3, 6)))
    gains = np.array([0.8, 1.0, 1.2])
    chosen = Candidate("plane", Verdict.CHOSEN, "it fits", corrections=Corrections(gains=gains))
    state = finished_state(PlaneMirror(plane, poses=poses), frame, chosen)
    folder = tmp_path / "prediction"
    acquire_prediction(folder)
    export_prediction(dataset, state, tiny_config(), folder)
    cameras = read_info(folder).cameras
    assert cameras is not None
    assert [each.name for each in cameras] == [each.name for each in dataset.train]
    for index, (found, stated) in enumerate(zip(cameras, dataset.train, strict=True)):
        view = TrainView(
            raster_camera(stated.camera, frame, 0.1), torch.zeros(3, 1, 1), torch.zeros(1, 1), torch.zeros(0).long()
        )
        moved = moved_view(view, Rotation.from_rotvec(poses.turns[index]).as_matrix(), poses.shifts[index])
        rotation, center = pose_of(moved.camera)
        turned = Rotation.from_rotvec(found.turn_deg, degrees=True).as_matrix() @ stated.camera.camera_to_world[:3, :3]
        np.testing.assert_allclose(rotation.T, turned, atol=1e-6)
        np.testing.assert_allclose(2 * center, stated.camera.position_world + found.shift, atol=1e-6)
        np.testing.assert_allclose(np.radians(found.turn_sigma_deg), poses.sigmas[index, :3])
        np.testing.assert_allclose(found.shift_sigma, 2 * poses.sigmas[index, 3:])
        assert found.gain == (gains[index],) * 3


@pytest.fixture(scope="module")
def plane_prediction(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The exact flat mirror and the exact environment, in a frame of twice the world's unit, exported; its dataset."""
    plane, radius, center = plane_of(RECTANGLE, offset=0.07), 2.0, np.array([0.3, -0.2, 0.1])
    dataset = make_plane_dataset(tmp_path_factory.mktemp("datasets") / "plane", plane, train=3)
    offset = (plane.offset - float(plane.normal @ center)) / radius
    shift = np.array([plane.tangent_u @ center, plane.tangent_v @ center])
    placed = replace(plane, offset=offset, boundary=(plane.boundary - shift) / radius)
    chosen = Candidate("plane", Verdict.CHOSEN, "explains held-out views", 0.05, 1.0, 0.01)
    state = finished_state(PlaneMirror(placed), ObjectFrame(center, radius), chosen)
    folder = tmp_path_factory.mktemp("predictions") / "plane"
    acquire_prediction(folder)
    (folder / "test").mkdir()
    (folder / "surfels.ply").write_text("of an earlier fit with surfels")
    export_prediction(dataset, state, tiny_config(), folder)
    return folder, dataset.root


def test_an_exact_plane_scores_perfect_normals(plane_prediction: tuple[Path, Path]) -> None:
    scores = evaluate(*plane_prediction, protocol="linear-v1")
    assert scores.normals is not None
    assert scores.normals.median_angular_error_deg < 0.01


def test_a_plane_renders_the_traced_views(plane_prediction: tuple[Path, Path]) -> None:
    """Alpha as traced with 36 points a pixel; depth and radiance of the mirror, in world units."""
    folder, root = plane_prediction
    for frame in open_dataset(root).test:
        found, truth = read_view(prediction_frame(folder, frame)), read_view(frame)
        np.testing.assert_allclose(found.alpha, truth.alpha, atol=0.08)
        whole = truth.alpha == 1
        assert whole.mean() > 0.1
        assert found.depth is not None
        assert truth.depth is not None
        np.testing.assert_allclose(found.depth[whole], truth.depth[whole], atol=1e-4)
        # Bilinear lookups in texels of 1.4°, and a sun clipped at 1.
        difference = np.abs(found.radiance - truth.radiance.clip(0, 1))[whole]
        assert difference.mean() < 3e-3


def test_a_plane_is_described_as_what_it_is(plane_prediction: tuple[Path, Path]) -> None:
    """Three numbers and four corners; one primitive; the reason in words; no surfels of an earlier fit beside it."""
    folder, _ = plane_prediction
    info = read_info(folder)
    expected = "plane (explains held-out views; silhouettes 0.05 px away, overlap 100%; "
    assert info.model == expected + "held-out error 0.0100)"
    assert info.primitives == 1
    assert info.parameter_counts == {"plane parameters": 3 + 8, "environment parameters": 6 * 3 * 64 * 64}
    assert info.model_bytes == sum((folder / name).stat().st_size for name in ("plane.ply", "environment.exr"))
    assert not (folder / "surfels.ply").exists()


def test_surfels_say_why_they_were_taken(prediction: Path, finished: FinishedFit, tmp_path: Path) -> None:
    """In the words of model selection; no other model lies beside them."""
    assert read_info(prediction).model == finished.state.selection.sentence == "surfels (requested)"
    refused = Candidate("plane", Verdict.REFUSED_BY_SILHOUETTES, "misses the silhouettes", 7.0, 0.8)
    chosen = Candidate("surfels", Verdict.CHOSEN, "no simpler kind explains the views")
    acquire_prediction(tmp_path)
    (tmp_path / "test").mkdir()
    for name in ("plane.ply", "revolution.ply"):
        (tmp_path / name).write_text("of an earlier fit")
    selection = Selection("surfels", (refused, chosen))
    export_prediction(finished.dataset, replace(finished.state, selection=selection), finished.config, tmp_path)
    reason = "before it plane: misses the silhouettes; silhouettes 7 px away, overlap 80%"
    assert read_info(tmp_path).model == f"surfels (no simpler kind explains the views); {reason}"
    for folder in (prediction, tmp_path):
        assert (folder / "surfels.ply").exists()
        assert not (folder / "plane.ply").exists()
        assert not (folder / "revolution.ply").exists()


@pytest.fixture(scope="module")
def ball_prediction(tmp_path_factory: pytest.TempPathFactory, sphere_dataset: Dataset) -> Path:
    """The traced sphere as an exact surface of revolution, in a frame of twice the world's unit, exported."""
    radius, center, sides = 2.0, np.array([0.3, -0.2, 0.1]), 360
    angle = np.linspace(-np.pi / 2, np.pi / 2, sides + 1)
    profile = np.stack([np.cos(angle).clip(0), np.sin(angle)], 1) / radius
    axis = np.array([0.6, 0.0, 0.8])
    middle = -center / radius
    height = float(middle @ axis)
    surface = SurfaceOfRevolution(middle - height * axis, axis, profile + np.array([0.0, height]), sides)
    requested = Candidate("revolution", Verdict.CHOSEN, "requested")
    state = finished_state(RevolutionMirror(surface), ObjectFrame(center, radius), requested)
    folder = tmp_path_factory.mktemp("predictions") / "ball"
    acquire_prediction(folder)
    export_prediction(sphere_dataset, state, tiny_config(), folder)
    return folder


def test_an_exact_surface_of_revolution_scores_perfect_normals(ball_prediction: Path, sphere_dataset: Dataset) -> None:
    """A side of the profile turns by half a degree, and interpolation goes between."""
    scores = evaluate(ball_prediction, sphere_dataset.root, protocol="linear-v1")
    assert scores.normals is not None
    assert scores.normals.median_angular_error_deg < 0.02


def test_a_surface_of_revolution_renders_the_traced_views(ball_prediction: Path, sphere_dataset: Dataset) -> None:
    """Alpha as traced with 25 points a pixel; depth and radiance of the mirror, in world units."""
    for frame in sphere_dataset.test:
        found, truth = read_view(prediction_frame(ball_prediction, frame)), read_view(frame)
        np.testing.assert_allclose(found.alpha, truth.alpha, atol=0.13)
        whole = truth.alpha == 1
        assert whole.mean() > 0.1
        assert found.depth is not None
        assert truth.depth is not None
        np.testing.assert_allclose(found.depth[whole], truth.depth[whole], atol=1e-3)
        difference = np.abs(found.radiance - truth.radiance.clip(0, 1))[whole]
        assert difference.mean() < 3e-3


def test_a_surface_of_revolution_is_described_as_what_it_is(ball_prediction: Path) -> None:
    """One primitive, the reason in words, and a mesh whose vertices lie on the traced sphere in world units."""
    info = read_info(ball_prediction)
    assert info.model == "revolution (requested)"
    assert info.primitives == 1
    assert info.parameter_counts == {"revolution parameters": 5 + 2 * 361, "environment parameters": 6 * 3 * 64 * 64}
    assert not (ball_prediction / "surfels.ply").exists()
    table = read_ply(ball_prediction / "revolution.ply")
    np.testing.assert_allclose(np.linalg.norm(vertices_of(table), axis=1), 1, atol=1e-6)
    assert table["faces"].shape[1] == 4
    assert table["faces"].min() == 0
    assert table["faces"].max() == len(table["x"]) - 1


def test_the_ply_of_a_plane_is_its_boundary_in_world_units(tmp_path: Path) -> None:
    plane, radius, center = plane_of(L_SHAPE), 2.0, np.array([10.0, -20.0, 30.0])
    write_ply(tmp_path / "p.ply", PlaneMirror(plane).mesh(ObjectFrame(center, radius)))
    table = read_ply(tmp_path / "p.ply")
    expected = [
        center + radius * (plane.offset * plane.normal + u * plane.tangent_u + v * plane.tangent_v) for u, v in L_SHAPE
    ]
    np.testing.assert_allclose(vertices_of(table), expected, atol=1e-6)
    assert table["faces"].tolist() == [[0, 1, 2, 3, 4, 5]]


def test_the_ply_of_a_height_field_is_its_mesh_in_world_units(tmp_path: Path) -> None:
    """Every vertex lies at its height over the plane; faces name vertices that exist."""
    height_field, frame = bumpy(plane_of(RECTANGLE), 0.02), ObjectFrame(np.array([1.0, -2.0, 0.5]), 3.0)
    write_ply(tmp_path / "h.ply", HeightFieldMirror(height_field).mesh(frame))
    points, faces = height_field.quadrilaterals()
    table = read_ply(tmp_path / "h.ply")
    np.testing.assert_allclose((vertices_of(table) - frame.center) / frame.radius, points, atol=1e-7)
    np.testing.assert_array_equal(table["faces"], faces)


def normals_in(table: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([table[name] for name in ("nx", "ny", "nz")], 1)


def test_the_normals_of_a_plane_and_of_a_height_field_are_in_the_ply(tmp_path: Path) -> None:
    """Those of the height field are perpendicular to differences of its heights."""
    height_field, frame = bumpy(plane_of(RECTANGLE), 0.02), ObjectFrame(np.array([1.0, -2.0, 0.5]), 3.0)
    plane = plane_of(RECTANGLE)
    write_ply(tmp_path / "p.ply", PlaneMirror(plane).mesh(frame))
    np.testing.assert_allclose(normals_in(read_ply(tmp_path / "p.ply")), [plane.normal] * 4, atol=1e-12)
    write_ply(tmp_path / "h.ply", HeightFieldMirror(height_field).mesh(frame))
    table, plane, step = read_ply(tmp_path / "h.ply"), height_field.plane, 1e-5
    points, normals = (vertices_of(table) - frame.center) / frame.radius, normals_in(table)
    places = np.stack([points @ plane.tangent_u, points @ plane.tangent_v], 1)
    inside = (np.abs(places - places.mean(0)) < 0.45 * np.ptp(places, axis=0)).all(1)
    for axis, tangent in enumerate((plane.tangent_u, plane.tangent_v)):
        shift = step * np.eye(2)[axis]
        rise = height_field.heights(places + shift, 0)[0] - height_field.heights(places - shift, 0)[0]
        along = (normals * (2 * step * tangent + rise[:, None] * plane.normal)).sum(1) / (2 * step)
        np.testing.assert_allclose(along[inside], 0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-12)
    assert (normals @ plane.normal > 0).all()


def test_the_normals_of_a_surface_of_revolution_are_in_the_ply_and_sharp_at_its_creases(tmp_path: Path) -> None:
    """A cup of flat and straight walls: at every face all normals are perpendicular to its meridian and outward."""
    profile = np.array([[0.0, 0], [0.5, 0], [0.5, 0.9], [0.4, 0.9], [0.4, 0.1], [0, 0.1]])
    axis = np.array([0.36, -0.48, 0.8])
    cup = SurfaceOfRevolution(np.array([0.1, 0.2, -0.3]), axis, profile, 2)
    write_ply(tmp_path / "r.ply", RevolutionMirror(cup).mesh(ObjectFrame(np.array([1.0, -2.0, 0.5]), 3.0)))
    table = read_ply(tmp_path / "r.ply")
    vertices, normals, faces = vertices_of(table), normals_in(table), table["faces"]
    corners = vertices[faces]
    along = corners[:, 3] - corners[:, 0]
    facing = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    # Quadrilaterals at the axis have two corners at one place; the diagonals span their plane all the same.
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    np.testing.assert_allclose((normals[faces] * along[:, None]).sum(-1), 0, atol=1e-6)
    # 128 meridians: a face turns by half a step against its vertices.
    assert (normals[faces] * facing[:, None]).sum(-1).min() > np.cos(np.pi / 128) - 1e-6
    assert len(faces) == 5 * 128


def test_a_map_of_a_near_room_is_that_of_the_world_s_origin() -> None:
    """A smooth light on a sphere about the object's center, seen from beside it: within the blur of a coarse map."""
    around, frame = Surroundings(np.array([0.25])), ObjectFrame(np.array([0.0, -0.6, 0.3]), 2.0)
    assert viewpoint_of(ObjectFrame(np.array([5.0, 0.0, 0.0]), 2.0)).tolist() == [0, 0, 0]
    standing = ObjectFrame(np.array([0.0, 0.0, 1.5]), 2.0)
    assert viewpoint_of(standing).tolist() == [0, 0, -0.75]
    on_table = Surroundings(np.zeros(1), Floor(np.array([0.0, 0.0, 1.0]), 0.75, 4.0))
    assert viewpoint_of(standing, on_table).tolist() == [0, 0, 0]
    viewpoint = viewpoint_of(frame)
    cube = cubemap_directions(32).movedim(-1, 1)
    found = cube_to_latlong(cube, 16, around, viewpoint)
    directions = latlong_directions(16)
    half = directions @ viewpoint
    walls = viewpoint + (np.sqrt(half**2 - viewpoint @ viewpoint + 16) - half)[..., None] * directions
    np.testing.assert_allclose(found, walls / 4, atol=0.01)
    assert np.abs(found - cube_to_latlong(cube, 16)).max() > 0.05
