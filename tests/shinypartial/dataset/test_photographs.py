"""Plain folders of any photographs: formats, masks, and cameras that differ from frame to frame."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from shinypartial.core.camera import Camera, look_at, opencv_to_opengl
from shinypartial.core.color import srgb_to_linear
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import open_dataset, read_view
from shinypartial.dataset.schema import View
from shinypartial.dataset.subset import SubsetOptions, make_subset
from shinypartial.dataset.transforms import read_frames
from shinypartial.dataset.validate import validate
from shinypartial.dataset.write import display_rgba
from shinypartial.io.images import write_exr, write_png
from tests.support.synthetic_dataset import make_plain_sphere_dataset, render_sphere

POSE = look_at(np.array([0.0, -3.0, 0.4]), np.zeros(3))
CAMERA = Camera(POSE, 40.0, 40.0, 16.0, 12.0, 32, 24)
#: Another camera: other size, focal lengths and center.
WIDE = Camera(look_at(np.array([1.0, -2.8, 0.2]), np.zeros(3)), 30.0, 33.0, 21.5, 15.0, 40, 28)


def store(path: Path, image: np.ndarray) -> None:
    """Write with straight alpha in the format that the suffix names."""
    spec = oiio.ImageSpec(image.shape[1], image.shape[0], image.shape[2], str(image.dtype).replace("float32", "float"))
    spec.attribute("oiio:UnassociatedAlpha", int(image.dtype.kind == "u"))
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec), file.geterror()
    assert file.write_image(np.ascontiguousarray(image))
    assert file.close()


def make_folder(root: Path, entries: list[dict[str, Any]], **shared: Any) -> Path:
    (root / "train").mkdir(parents=True, exist_ok=True)
    (root / "transforms_train.json").write_text(json.dumps({**shared, "frames": entries}))
    return root


def entry(camera: Camera, name: str, **own: Any) -> dict[str, Any]:
    return {"file_path": name, "transform_matrix": opencv_to_opengl(camera.camera_to_world).tolist(), **own}


def intrinsics(camera: Camera) -> dict[str, Any]:
    return {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy} | {
        "w": camera.width,
        "h": camera.height,
    }


def photograph(view: View, suffix: str) -> np.ndarray:
    """The picture of a view in the encoding that the format stands for."""
    linear = np.concatenate([view.radiance, view.alpha[..., None]], -1).astype(np.float32)
    codes = display_rgba(view.radiance, view.alpha)
    return {
        ".png": codes,
        ".PNG": codes,
        ".tif": codes,
        ".jpg": codes[..., :3],
        ".jpeg": codes[..., :3],
        ".hdr": linear[..., :3],
        ".tiff": linear,
    }[suffix]


@pytest.mark.parametrize("suffix", [".png", ".PNG", ".tif", ".tiff", ".jpg", ".jpeg", ".hdr"])
@pytest.mark.parametrize("named", [True, False], ids=["with extension", "without"])
def test_a_photograph_of_any_format_is_the_same_view(tmp_path: Path, suffix: str, named: bool) -> None:
    rendered = render_sphere(CAMERA)
    name = f"train/r_0{suffix if named else ''}"
    make_folder(tmp_path, [entry(CAMERA, name)], **intrinsics(CAMERA))
    picture = photograph(rendered, suffix)
    store(tmp_path / f"train/r_0{suffix}", picture)
    if picture.shape[2] == 3:
        mask = np.rint(rendered.alpha * 255).astype(np.uint8)
        write_png(tmp_path / "train/r_0_alpha.png", mask)
    (frame,) = open_dataset(tmp_path).train
    view = read_view(frame)
    assert view.high_dynamic_range == (suffix in (".hdr", ".tiff"))
    np.testing.assert_allclose(view.alpha, rendered.alpha, atol=0.51 / 255)
    inside = rendered.alpha == 1
    expected = rendered.radiance if view.high_dynamic_range else np.minimum(rendered.radiance, 1)
    # Half a step of 8 bits at the steepest slope of sRGB decoding; blocks of a JPEG reach further.
    tolerance = 0.25 if suffix in (".jpg", ".jpeg") else 1.7 / 255
    if suffix == ".hdr":
        # The channels of a pixel share an exponent.
        tolerance = float(rendered.radiance.max()) * 2**-7
    assert np.abs(view.radiance - expected)[inside].max() < tolerance


def test_16_bits_are_read_in_full(tmp_path: Path) -> None:
    codes = np.random.default_rng(0).integers(0, 65536, (24, 32, 4)).astype(np.uint16)
    make_folder(tmp_path, [entry(CAMERA, "train/r_0")], **intrinsics(CAMERA))
    store(tmp_path / "train/r_0.png", codes)
    view = read_view(open_dataset(tmp_path).train[0])
    alpha = codes[..., 3] / 65535
    np.testing.assert_allclose(view.alpha, alpha, atol=1e-6)
    np.testing.assert_allclose(view.radiance, srgb_to_linear(codes[..., :3] / 65535) * alpha[..., None], atol=1e-6)


def test_the_exr_beside_a_photograph_is_read(tmp_path: Path) -> None:
    make_folder(tmp_path, [entry(CAMERA, "train/r_0.jpg")], **intrinsics(CAMERA))
    store(tmp_path / "train/r_0.jpg", np.zeros((24, 32, 3), np.uint8))
    write_exr(tmp_path / "train/r_0.exr", {name: np.full((24, 32), 0.5, np.float16) for name in "RGBA"})
    view = read_view(open_dataset(tmp_path).train[0])
    assert view.high_dynamic_range
    assert (view.radiance == 0.5).all()


def test_the_named_extension_is_the_one_that_is_read(tmp_path: Path) -> None:
    make_folder(tmp_path, [entry(CAMERA, "train/r_0.tif")], **intrinsics(CAMERA))
    store(tmp_path / "train/r_0.png", np.zeros((24, 32, 4), np.uint8))
    store(tmp_path / "train/r_0.tif", np.full((24, 32, 4), 255, np.uint8))
    assert (read_view(open_dataset(tmp_path).train[0]).radiance == 1).all()


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".exr", ".tiff"])
def test_mask_path_is_the_mask(tmp_path: Path, suffix: str) -> None:
    """As nerfstudio writes it; it counts more than an alpha channel, whose share in the color is undone."""
    mask = np.zeros((24, 32), np.uint8)
    mask[4:20, 8:24] = 255
    mask[4, 8:24] = 51
    make_folder(tmp_path, [entry(CAMERA, f"train/r_0{suffix}", mask_path="masks/0.png")], **intrinsics(CAMERA))
    write_png(tmp_path / "masks/0.png", mask)
    path = tmp_path / f"train/r_0{suffix}"
    color, opacity = 0.5, 0.25
    if suffix == ".exr":
        planes = {name: np.full((24, 32), color * opacity, np.float32) for name in "RGB"}
        write_exr(path, planes | {"A": np.full((24, 32), opacity, np.float32)})
    elif suffix == ".tiff":
        store(path, np.broadcast_to(np.float32([color * opacity] * 3 + [opacity]), (24, 32, 4)))
    else:
        codes = np.full((24, 32, 3 if suffix == ".jpg" else 4), 188, np.uint8)
        store(path, codes)
        color = float(srgb_to_linear(np.array(188 / 255)))
    view = read_view(open_dataset(tmp_path).train[0])
    np.testing.assert_allclose(view.alpha, mask / 255, atol=1e-6)
    np.testing.assert_allclose(view.radiance, (color * mask / 255)[..., None].repeat(3, -1), atol=1e-6)


def test_a_mask_path_that_is_missing_or_of_another_size_is_refused(tmp_path: Path) -> None:
    make_folder(tmp_path, [entry(CAMERA, "train/r_0", mask_path="masks/0.png")], **intrinsics(CAMERA))
    store(tmp_path / "train/r_0.png", np.zeros((24, 32, 4), np.uint8))
    (frame,) = open_dataset(tmp_path).train
    with pytest.raises(InputError, match=r"masks/0\.png; found no such file"):
        read_view(frame)
    write_png(tmp_path / "masks/0.png", np.zeros((24, 31), np.uint8))
    with pytest.raises(InputError, match="in the size of train/r_0"):
        read_view(frame)


def same_camera(found: Camera, expected: Camera) -> None:
    np.testing.assert_allclose(found.camera_to_world, expected.camera_to_world, atol=1e-12)
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-12), name


def test_two_cameras_in_one_folder(tmp_path: Path) -> None:
    """Each frame with its own intrinsics and size, as nerfstudio writes them: views come out as they were rendered."""
    cameras = [CAMERA, WIDE]
    entries = [entry(camera, f"train/r_{i}", **intrinsics(camera)) for i, camera in enumerate(cameras)]
    make_folder(tmp_path, entries)
    for i, camera in enumerate(cameras):
        view = render_sphere(camera)
        write_png(tmp_path / f"train/r_{i}.png", display_rgba(view.radiance, view.alpha))
    frames = open_dataset(tmp_path).train
    for frame, camera in zip(frames, cameras, strict=True):
        same_camera(frame.camera, camera)
        np.testing.assert_allclose(read_view(frame).alpha, render_sphere(camera).alpha, atol=0.51 / 255)
    assert [each for each in validate(tmp_path) if not each.warning] == []


OWN: dict[str, tuple[dict[str, Any], dict[str, Any], Camera]] = {
    "all of them": (intrinsics(WIDE), intrinsics(CAMERA), WIDE),
    "a focal length": ({"fl_x": 50.0}, intrinsics(CAMERA), replace(CAMERA, fx=50.0, fy=50.0)),
    "a focal length in y": ({"fl_y": 41.0}, intrinsics(CAMERA), replace(CAMERA, fy=41.0)),
    "an angle": ({"camera_angle_x": math.pi / 2}, intrinsics(CAMERA), replace(CAMERA, fx=16.0, fy=16.0)),
    "a center": ({"cx": 15.0}, intrinsics(CAMERA), replace(CAMERA, cx=15.0)),
    "a center at zero": ({"cx": 0.0}, intrinsics(CAMERA), replace(CAMERA, cx=0.0)),
    "the same size": ({"w": 32, "h": 24.0}, intrinsics(CAMERA), CAMERA),
    "another size, under one angle": (
        {"w": 64, "h": 48},
        {"camera_angle_x": math.pi / 2, "w": 32, "h": 24, "cx": 15.0},
        Camera(POSE, 32.0, 32.0, 32.0, 24.0, 64, 48),
    ),
}


@pytest.mark.parametrize(("own", "shared", "expected"), OWN.values(), ids=OWN.keys())
def test_what_a_frame_gives_itself_replaces_what_the_file_gives(
    tmp_path: Path, own: dict[str, Any], shared: dict[str, Any], expected: Camera
) -> None:
    first = entry(replace(CAMERA, camera_to_world=expected.camera_to_world), "train/r_0", **own)
    make_folder(tmp_path, [first, entry(CAMERA, "train/r_1")], **shared)
    (changed, other), count, errors = read_frames(tmp_path, "train")
    assert (count, errors) == (2, [])
    same_camera(changed.camera, expected)
    if shared.keys() == intrinsics(CAMERA).keys():
        same_camera(other.camera, CAMERA)


def test_a_frame_with_a_focal_length_and_no_size_has_that_of_its_picture(tmp_path: Path) -> None:
    entries = [entry(CAMERA, "train/r_0.png", fl_x=40.0), entry(WIDE, "train/r_1.jpg", fl_x=30.0)]
    make_folder(tmp_path, entries)
    store(tmp_path / "train/r_0.png", np.zeros((24, 32, 4), np.uint8))
    store(tmp_path / "train/r_1.jpg", np.zeros((28, 40, 3), np.uint8))
    first, second = open_dataset(tmp_path).train
    assert (first.camera.width, first.camera.height, first.camera.cx) == (32, 24, 16)
    assert (second.camera.width, second.camera.height, second.camera.cy) == (40, 28, 14)


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "distortion": ({"k1": 0.1}, "lens distortion \\(k1"),
    "tangential distortion": ({"k1": 0, "p2": -0.01}, "lens distortion \\(p2"),
    "a negative focal length": ({"fl_x": -1}, "`fl_x` of train/r_1 .*a number above 0"),
    "a size in words": ({"w": "wide"}, "`w` of train/r_1 .*found 'wide'"),
    "an angle in degrees": ({"camera_angle_x": 40.0}, "radians.*above 0 and below 3.14"),
    "another size, with a focal length for the first": ({"w": 64, "h": 48}, "camera_angle_x or fl_x for train/r_1"),
}


@pytest.mark.parametrize(("own", "problem"), REFUSED.values(), ids=REFUSED.keys())
def test_a_frame_whose_own_intrinsics_cannot_be_used_is_named(
    tmp_path: Path, own: dict[str, Any], problem: str
) -> None:
    make_folder(tmp_path, [entry(CAMERA, "train/r_0"), entry(CAMERA, "train/r_1", **own)], **intrinsics(CAMERA))
    with pytest.raises(InputError, match=problem):
        open_dataset(tmp_path)
    assert any("train/r_1" in each.problem for each in validate(tmp_path))


def test_a_subset_takes_pictures_masks_and_intrinsics_along(tmp_path: Path) -> None:
    source = make_plain_sphere_dataset(tmp_path / "source")
    for split in ("train", "test"):
        path = source.root / f"transforms_{split}.json"
        content = json.loads(path.read_text())
        for index, (frame, item) in enumerate(zip(source.split(split), content["frames"], strict=True)):
            codes = display_rgba(*(getattr(read_view(frame), name) for name in ("radiance", "alpha")))
            frame.png.unlink()
            store(frame.stem.with_suffix(".tif"), codes[..., :3])
            write_png(source.root / f"masks/{split}_{index}.png", codes[..., 3])
            item |= {"file_path": item["file_path"] + ".tif", "mask_path": f"masks/{split}_{index}.png"}
            item |= {"fl_x": frame.camera.fx + index}
        path.write_text(json.dumps(content))
    source = open_dataset(source.root)
    sources = {frame.camera.position_world.tobytes(): frame for frame in (*source.train, *source.test)}
    subset = open_dataset(make_subset(source.root, tmp_path / "subset", SubsetOptions(around=(0.0, 20.0))).root)
    assert len(subset.train) + len(subset.test) == len(sources)
    for frame in (*subset.train, *subset.test):
        original = sources[frame.camera.position_world.tobytes()]
        assert frame.camera.fx == original.camera.fx
        np.testing.assert_array_equal(read_view(frame).alpha, read_view(original).alpha)
        np.testing.assert_array_equal(read_view(frame).radiance, read_view(original).radiance)
