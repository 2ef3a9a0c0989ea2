"""Every method's map, renders and normals, written by its own formulas, come back in our frame and encoding."""

from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from shinypartial.conversion.layouts import LAYOUTS, LayoutName
from shinypartial.conversion.outside import Cost, import_result
from shinypartial.core.color import srgb_to_linear
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import sample_latlong
from shinypartial.dataset.read import read_view
from shinypartial.dataset.schema import Dataset
from shinypartial.evaluation.evaluate import evaluate
from shinypartial.evaluation.view_scores import read_prediction, score_view
from shinypartial.io.images import read_png, write_hdr, write_png
from shinypartial.prediction.format import ENVIRONMENT, read_environment_map, read_info, read_visibility

NAMES: tuple[LayoutName, ...] = get_args(LayoutName)
ITERATION = 30
HEIGHT = 64
#: Of +X, −X, +Y, −Y, +Z, −Z.
AXES = np.concatenate([np.stack([axis, -axis]) for axis in np.eye(3)])
COLORS = np.array([[255, 0, 0], [0, 255, 255], [0, 255, 0], [255, 0, 255], [40, 90, 255], [200, 120, 10]], np.uint8)


def z_up(height: int) -> np.ndarray:
    """(sin θ cos φ, sin θ sin φ, cos θ), φ from −π to π and θ from 0 to π, both ends included."""
    phi, theta = np.meshgrid(np.linspace(-np.pi, np.pi, 2 * height), np.linspace(0, np.pi, height))
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)


def y_up(height: int) -> np.ndarray:
    """(sin θ sin φ, cos θ, −sin θ cos φ), θ/π from 1/H to 1 − 1/H and φ/π from −1 + 1/W to 1 − 1/W."""
    low = 1 / (2 * height)
    phi, theta = np.meshgrid(np.linspace(-1 + low, 1 - low, 2 * height), np.linspace(2 * low, 1 - 2 * low, height))
    sine = np.sin(np.pi * theta)
    return np.stack([sine * np.sin(np.pi * phi), np.cos(np.pi * theta), -sine * np.cos(np.pi * phi)], -1)


def splatted(height: int) -> np.ndarray:
    """Texel (i, j) gathers what has (φ + π)/2π · W = j, φ = atan2(y, x), and acos(z)/π · (H − 1) = i."""
    j, i = np.meshgrid(np.arange(2 * height), np.arange(height))
    phi, theta = 2 * np.pi * j / (2 * height) - np.pi, np.pi * i / (height - 1)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)


#: File of the map and its chart.
MAPS: dict[str, tuple[str, Callable[[int], np.ndarray]]] = {
    "3dgs-dr": ("light1.png", z_up),
    "ref-gaussian": ("env2.png", z_up),
    "materialrefgs": ("env2.png", z_up),
    "gaussianshader": ("brdf_mlp/iteration_30/brdf_mlp.hdr", y_up),
    "panoless-paper": ("envmap_env_cood1_000030.png", z_up),
}
#: Renders and normals of view 1.
PICTURES = {
    "3dgs-dr": ("test/ours_30/renders/rgb/00001.png", "test/ours_30/renders/normal/00001.png"),
    "ref-gaussian": ("test/renders/rgb/00001.png", "test/renders/normal/00001.png"),
    "materialrefgs": ("test/renders/rgb/00001.png", "test/renders/normal/00001.png"),
    "gaussianshader": ("test/ours_30/renders/00001.png", "test/ours_30/normal/00001.png"),
    "panoless-paper": ("iteration-30/pbr_rgb/pbr_rgb_001.png", "iteration-30/render_normal/render_normal_001.png"),
}
PLY = b"ply\nformat binary_little_endian 1.0\nelement vertex 1234\nproperty float x\nend_header\n\xff\x00"


def begin(folder: Path, arguments: str = "white_background=True") -> Path:
    """What every one of these programs leaves."""
    saved = folder / f"point_cloud/iteration_{ITERATION}"
    saved.mkdir(parents=True)
    (folder / "point_cloud/iteration_7").mkdir()
    (saved / "point_cloud.ply").write_bytes(PLY)
    (folder / "cfg_args").write_text(f"Namespace(sh_degree=3, {arguments}, eval=True)")
    return folder


def write_map(folder: Path, name: str, codes_of: Callable[[np.ndarray], np.ndarray]) -> None:
    """Write 8-bit codes by direction, or as an HDR that holds the codes over 255."""
    file, chart = MAPS[name]
    codes = codes_of(chart(HEIGHT))
    if file.endswith(".hdr"):
        write_hdr(folder / file, (codes / 255).astype(np.float32))
    else:
        write_png(folder / file, codes)


def nearest_axis(directions: np.ndarray) -> np.ndarray:
    """The color of the axis that a direction is nearest to."""
    return COLORS[np.argmax(directions @ AXES.T, -1)]


def slopes(directions: np.ndarray) -> np.ndarray:
    """Codes that rise with each coordinate: 255 (d + 1)/2."""
    return np.rint(255 * (directions + 1) / 2).astype(np.uint8)


def to_code(codes: np.ndarray) -> np.ndarray:
    return srgb_to_linear(codes / 255)


@pytest.mark.parametrize("name", NAMES)
def test_every_axis_has_its_color(tmp_path: Path, sphere_dataset: Dataset, name: LayoutName) -> None:
    write_map(begin(tmp_path / "run"), name, nearest_axis)
    import_result(name, tmp_path / "run", sphere_dataset.root, tmp_path / "out")
    found = sample_latlong(read_environment_map(tmp_path / "out"), AXES)
    # RGBE stores 8 bits of the largest channel: 1/256 of it, which sRGB's slope of at most 2.3 makes 0.009.
    np.testing.assert_allclose(found, to_code(COLORS), atol=0.01)


@pytest.mark.parametrize("name", NAMES)
def test_maps_agree_in_all_directions(tmp_path: Path, sphere_dataset: Dataset, name: LayoutName) -> None:
    """Half a texel, which axes don't show, is up to 0.025 on these 64 rows. 8 bits leave 0.0040, RGBE 0.0123."""
    write_map(begin(tmp_path / "run"), name, slopes)
    import_result(name, tmp_path / "run", sphere_dataset.root, tmp_path / "out")
    random = np.random.default_rng(0).normal(size=(2000, 3))
    directions = random / np.linalg.norm(random, axis=1, keepdims=True)
    found = sample_latlong(read_environment_map(tmp_path / "out"), directions)
    expected = to_code(255 * (directions + 1) / 2)
    assert np.abs(found - expected).max() < (0.013 if MAPS[name][0].endswith(".hdr") else 0.005)


def test_a_linear_map_is_not_decoded(tmp_path: Path, sphere_dataset: Dataset) -> None:
    write_map(begin(tmp_path / "run", "srgb=True, white_background=True"), "ref-gaussian", nearest_axis)
    import_result("ref-gaussian", tmp_path / "run", sphere_dataset.root, tmp_path / "out")
    np.testing.assert_allclose(sample_latlong(read_environment_map(tmp_path / "out"), AXES), COLORS / 255, atol=0.001)


def numbered(name: str, pattern: int, number: int) -> str:
    digits = 3 if name == "panoless-paper" else 5
    return PICTURES[name][pattern].replace("1".zfill(digits) + ".png", f"{number:0{digits}d}.png")


def write_views(
    folder: Path, name: str, dataset: Dataset, order: list[int], change: Callable[[np.ndarray], np.ndarray]
) -> None:
    """Write the dataset's own pictures as the method would, number n showing view order[n]; codes are changed before.

    All but the paper's code blend sRGB codes over white; that one multiplies codes and (n + 1)/2 by its mask.
    """
    for number, index in enumerate(order):
        frame = dataset.test[index]
        stored = read_png(frame.png)
        straight, alpha = change(stored[..., :3]) / 255, stored[..., 3:] / 255
        normals = read_png(frame.normal_png) / 255
        if name == "panoless-paper":
            render, normals = straight * alpha, normals * alpha
            mask = np.repeat(stored[..., 3:], 3, -1)
            write_png(folder / f"iteration-30/render_alpha/render_alpha_{number:03d}.png", mask)
            write_png(folder / f"iteration-30/gt_image/gt_image_{number:03d}.png", stored)
        else:
            render = straight * alpha + 1 - alpha
        for pattern, picture in enumerate((render, normals)):
            write_png(folder / numbered(name, pattern, number), np.rint(255 * picture).astype(np.uint8))


def moved_by_ten(codes: np.ndarray) -> np.ndarray:
    """Every code 10 away from what it was, within 0 to 255."""
    return np.where(codes < 128, codes + 10, codes - 10).astype(np.uint8)


@pytest.mark.parametrize("name", NAMES)
def test_views_have_the_psnr_of_their_codes(tmp_path: Path, sphere_dataset: Dataset, name: LayoutName) -> None:
    """Codes 10 off are 20 log₁₀ 25.5 = 28.13 dB; the same codes are as far off as rounding to 8 bits makes them.

    Rounding is uniform in half a code either way: 20 log₁₀ 255 + 10 log₁₀ 12 = 58.9 dB, of which half precision of the
    EXR takes its share.
    """
    order = [2, 0, 1] if LAYOUTS[name].photographs else [0, 1, 2]
    for change, expected in ((moved_by_ten, 28.13), (np.asarray, 58.0)):
        run, out = tmp_path / change.__name__, tmp_path / f"{change.__name__}-out"
        write_views(begin(run), name, sphere_dataset, order, change)
        imported = import_result(name, run, sphere_dataset.root, out, cost=Cost(60.0, "GPU"))
        assert imported.test_views == 3
        for frame in sphere_dataset.test:
            scored = score_view(frame, read_prediction(out, frame), read_view(frame), None, with_paper=False)
            assert scored.psnr_foreground is not None
            assert scored.scores.mean_angular_error_deg is not None
            assert scored.psnr_foreground == pytest.approx(expected, abs=0.1 if expected < 30 else 2)
            # 8 bits leave 0.2°.
            assert scored.scores.mean_angular_error_deg < 0.3
    info = read_info(out)
    assert (info.primitives, info.seconds, info.hardware_text) == (1234, {"fit": 60.0}, "device GPU")
    assert any(reason.startswith("environment: no ") for reason in imported.left_out)


def test_pixels_without_a_normal_are_holes(tmp_path: Path, sphere_dataset: Dataset) -> None:
    """Gray is no vector; white and black are a background, longer than any blend of unit vectors."""
    write_views(begin(tmp_path / "run"), "gaussianshader", sphere_dataset, [0, 1, 2], np.asarray)
    frame, path = sphere_dataset.test[1], tmp_path / "run" / PICTURES["gaussianshader"][1]
    picture, solid = read_png(path), read_view(frame).alpha > 0.99
    picture[solid] = np.resize(np.array([[128], [255], [0]], np.uint8), (int(solid.sum()), 1))
    write_png(path, picture)
    import_result("gaussianshader", tmp_path / "run", sphere_dataset.root, tmp_path / "out")
    assert not read_prediction(tmp_path / "out", frame).normals_world[solid].any()


def test_views_of_which_some_are_overwritten_are_left_out(tmp_path: Path, sphere_dataset: Dataset) -> None:
    """The paper's code writes training views over its first test views: their photographs decide."""
    run, out = begin(tmp_path / "run"), tmp_path / "out"
    write_views(run, "panoless-paper", sphere_dataset, [2, 0, 1], np.asarray)
    write_png(run / "iteration-30/gt_image/gt_image_000.png", read_png(sphere_dataset.train[0].png))
    write_map(run, "panoless-paper", slopes)
    seen = np.rint(255 * np.clip(splatted(HEIGHT)[..., 1:2], 0, 1)).astype(np.uint8)
    write_png(run / "envmap_env_usage_000030.png", np.repeat(seen, 3, -1))
    imported = import_result("panoless-paper", run, sphere_dataset.root, out)
    assert imported.test_views == 0
    assert "1 of 3" in imported.left_out[0]
    assert "r_002" in imported.left_out[0]
    visibility = read_visibility(out)
    assert visibility is not None
    np.testing.assert_allclose(sample_latlong(visibility[..., None], AXES)[:, 0], [0, 0, 1, 0, 0, 0], atol=0.03)
    (out / ENVIRONMENT).unlink()  # Other tests score maps; here it would only take time.
    scores = evaluate(out, protocol="linear-v1")
    assert scores.render is None
    assert {"render", "normals"} <= {one.name for one in scores.left_out}


def test_the_datasets_masks_are_not_scored(tmp_path: Path, sphere_dataset: Dataset) -> None:
    write_views(begin(tmp_path / "run"), "3dgs-dr", sphere_dataset, [0, 1, 2], np.asarray)
    import_result("3dgs-dr", tmp_path / "run", sphere_dataset.root, tmp_path / "out")
    scores = evaluate(tmp_path / "out", protocol="linear-v1")
    assert scores.render is not None
    assert scores.render.alpha_iou is None
    assert scores.render.psnr > 50
    assert "render.alpha_iou" in {one.name for one in scores.left_out}


def test_what_cannot_be_imported_leaves_nothing(tmp_path: Path, sphere_dataset: Dataset) -> None:
    empty, plain = begin(tmp_path / "empty"), begin(tmp_path / "plain", "sh_degree=3")
    write_views(plain, "3dgs-dr", sphere_dataset, [0, 1, 2], np.asarray)
    for folder, word in ((empty, "results of 3DGS-DR"), (plain, "white_background"), (tmp_path, "iteration_N")):
        with pytest.raises(InputError, match=word):
            import_result("3dgs-dr", folder, sphere_dataset.root, tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "plain"]
    import_result("3dgs-dr", plain, sphere_dataset.root, tmp_path / "out", background="white")
    with pytest.raises(InputError, match="new or empty"):
        import_result("3dgs-dr", plain, sphere_dataset.root, tmp_path / "out", background="white")
