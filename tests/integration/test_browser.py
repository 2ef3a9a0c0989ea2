"""What leaves this project for a browser, in a browser: light and mirror by three.js beside Blender, the viewer, the
report.

These tests need Chromium, and three.js from npm; `pytest -m browser` runs them.
"""

import shutil
import subprocess
import tarfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Bool, UInt8

from panoless.viewer.server import Address, open_prediction
from shinypartial.conversion.convert import convert
from shinypartial.conversion.light import Layout
from shinypartial.conversion.scenes import THREE
from shinypartial.core.color import to_display
from shinypartial.core.sphere import latlong_directions
from shinypartial.dataset.schema import Dataset
from shinypartial.evaluation.evaluate import evaluate
from shinypartial.io.images import read_exr_rgb
from shinypartial.prediction.format import PredictionInfo, write_environment_map, write_info
from shinypartial.report.page import write_report
from tests.panoless.viewer.test_content import written
from tests.shinypartial.conversion.test_blender import ball, quiet, reopened
from tests.support.browser import Page, browser_path, opened_browser, served
from tests.support.truth_prediction import write_truth_prediction

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(browser_path() is None, reason="Chromium is not installed"),
]
SIZE = 256
AXES = np.concatenate([np.eye(3), -np.eye(3)])
#: Of the world along +X, +Y, +Z, −X, −Y, −Z; all below 1, so that nothing is clipped.
COLORS = np.array(
    [[0.9, 0.1, 0.1], [0.1, 0.8, 0.1], [0.15, 0.2, 0.9], [0.1, 0.7, 0.7], [0.7, 0.1, 0.6], [0.6, 0.5, 0.1]]
)
#: Codes of 255 by which flat colors may differ: .hdr has 8 bits a channel, and so has the picture.
CODES = 4
#: The same of colors in the mirror, whose grazing reflectance three.js approximates; the world's differ by 60 and more.
MIRRORED_CODES = 16
READY_WITHIN_S = 90.0
#: The directions of the camera that `web_page` begins with, in world axes: (x, y, z) there is (x, −z, y).
EYE = np.array([0.35, -1.0, 0.45])
#: The lines that docs/how-to/use-the-light.md gives for a page of one's own.
OWN_PAGE = """<!DOCTYPE html><meta charset="utf-8"><style>body { margin: 0 }</style>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js", "three/addons/": "/three/examples/jsm/"}}
</script><script type="module">
import * as THREE from "three";
import { HDRCubeTextureLoader } from "three/addons/loaders/HDRCubeTextureLoader.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(35, 1, 0.01, 1000);
const light = await new HDRCubeTextureLoader().setPath("web/").loadAsync(
  ["px.hdr", "nx.hdr", "py.hdr", "ny.hdr", "pz.hdr", "nz.hdr"]);
scene.environment = scene.background = light;
scene.add((await new GLTFLoader().loadAsync("web/surface.glb")).scene);
camera.position.set(0.35, 0.45, 1).setLength(4);
camera.lookAt(0, 0, 0);
const renderer = new THREE.WebGLRenderer({ antialias: true });
renderer.setSize(innerWidth, innerHeight);
document.body.append(renderer.domElement);
renderer.setAnimationLoop(() => { renderer.render(scene, camera); window.drawn = true; });
</script>"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with opened_browser(tmp_path_factory.mktemp("browser")) as page:
        yield page


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """three.js of the version that pages fetch, from npm."""
    folder, package = tmp_path_factory.mktemp("three"), THREE.rsplit("/", 1)[1]
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is not installed")
    subprocess.run([npm, "pack", "--silent", package], cwd=folder, check=True, capture_output=True, timeout=120)
    with tarfile.open(next(folder.glob("*.tgz"))) as archive:
        archive.extractall(folder, filter="data")
    return folder / "package"


@pytest.fixture(scope="module")
def prediction(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A unit ball in a world of six flat colors, each about an axis."""
    folder = tmp_path_factory.mktemp("axes") / "p"
    write_environment_map(folder, COLORS[np.argmax(latlong_directions(256) @ AXES.T, -1)].astype(np.float32))
    write_info(folder, PredictionInfo("m", "none", "", {}, {}, {}, {}, 0))
    ball(folder)
    return folder


@pytest.fixture(scope="module")
def blender(prediction: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same for Blender."""
    pytest.importorskip("bpy")
    folder = tmp_path_factory.mktemp("blender")
    convert(prediction, ("blender",), folder)
    return folder / "scene.blend"


def by_blender(file: Path, distance: float) -> UInt8[np.ndarray, "H W 3"]:
    """What Blender shows from the direction of the pages' cameras."""
    from mathutils import Vector

    bpy = reopened(file)
    scene, camera = bpy.context.scene, bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    camera.data.angle = np.radians(35)
    camera.location = distance * EYE / np.linalg.norm(EYE)
    camera.rotation_euler = Vector(-EYE).to_track_quat("-Z", "Y").to_euler()
    scene.collection.objects.link(camera)
    scene.camera, scene.cycles.samples = camera, 16
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.render.image_settings.file_format, scene.render.filepath = "OPEN_EXR", str(file.parent / "seen.exr")
    with quiet():
        bpy.ops.render.render(write_still=True)
    return to_display(read_exr_rgb(file.parent / "seen.exr"))


def flat(picture: UInt8[np.ndarray, "H W 3"]) -> Bool[np.ndarray, "H W"]:
    """Pixels in the middle of 7 × 7 of one color."""
    from scipy.ndimage import maximum_filter, minimum_filter

    size = (7, 7, 1)
    spread = maximum_filter(picture, size).astype(int) - minimum_filter(picture, size)
    return spread.max(-1) <= CODES


def agreement(one: UInt8[np.ndarray, "H W 3"], other: UInt8[np.ndarray, "H W 3"]) -> float:
    """Share of the pixels that are flat in both whose colors are equal."""
    both = flat(one) & flat(other)
    assert both.mean() > 0.5
    return float((np.abs(one.astype(int) - other)[both].max(-1) <= MIRRORED_CODES).mean())


def drawn(page: Page) -> bool:
    """Whether a page has drawn something in its canvas, which holds more than one color."""
    return bool(page.value("!!document.querySelector('canvas')")) and len(np.unique(page.picture())) > 10


def by_cube_map(
    browser: Page, three: Path, prediction: Path, folder: Path, layout: Layout
) -> UInt8[np.ndarray, "H W 3"]:
    """What `OWN_PAGE` shows of a prediction's cube map and GLB."""
    convert(prediction, ("cubemap", "glb"), folder / "web", layout=layout)
    (folder / "index.html").write_text(OWN_PAGE)
    (folder / "three").symlink_to(three)
    with served(folder) as address:
        browser.open(f"{address}/index.html", SIZE, SIZE)
        browser.wait_until(lambda: browser.value("!!window.drawn") and drawn(browser), READY_WITHIN_S)
        return browser.picture()


def test_the_page_shows_what_blender_shows(
    browser: Page, three: Path, prediction: Path, blender: Path, tmp_path: Path
) -> None:
    """World and mirror ball, from one camera; the page is as it is, but for where three.js comes from.

    It steps back by four radii of the ball about the box around the surface, √3 for a unit ball.
    """
    convert(prediction, ("threejs",), tmp_path)
    page = (tmp_path / "index.html").read_text()
    (tmp_path / "index.html").write_text(page.replace(THREE, "/three"))
    (tmp_path / "three").symlink_to(three)
    with served(tmp_path) as address:
        browser.open(f"{address}/index.html", SIZE, SIZE)
        browser.wait_until(lambda: drawn(browser), READY_WITHIN_S)
        assert agreement(browser.picture(), by_blender(blender, 4 * 3**0.5)) > 0.99


def test_cube_map_and_surface_show_what_blender_shows(
    browser: Page, three: Path, prediction: Path, blender: Path, tmp_path: Path
) -> None:
    """By the lines of the page about using the light."""
    lines = (Path(__file__).parents[2] / "docs" / "how-to" / "use-the-light.md").read_text()
    assert all(line in lines for line in OWN_PAGE.splitlines() if "web/" in line or "scene.environment" in line)
    assert agreement(by_cube_map(browser, three, prediction, tmp_path, "three"), by_blender(blender, 4.0)) > 0.99


def test_cube_maps_for_other_programs_are_mirrored(
    browser: Page, three: Path, prediction: Path, blender: Path, tmp_path: Path
) -> None:
    """So that the tests above can fail: three.js exchanges ±x of a map in OpenGL's own layout."""
    assert agreement(by_cube_map(browser, three, prediction, tmp_path, "opengl"), by_blender(blender, 4.0)) < 0.98


def test_the_viewer_shows_surface_light_and_controls(browser: Page, sphere_dataset: Dataset, tmp_path: Path) -> None:
    """The surface is gray and in the middle; the world around it and the test view in the panel are not."""
    pytest.importorskip("viser")
    viewer = open_prediction(written(tmp_path, sphere_dataset), Address(port=8139))
    try:
        browser.open(viewer.url, 1000, 700)
        texts = ("Moment: end", "Ray of a pixel", "Test views")
        shown = "document.body ? document.body.innerText : ''"
        browser.wait_until(lambda: all(each in browser.value(shown) for each in texts), READY_WITHIN_S)

        def middle_is_gray() -> bool:
            middle = browser.picture()[340:360, 490:510].astype(int)
            return bool((np.ptp(middle, -1) < 40).all() and middle.min() > 40)

        browser.wait_until(middle_is_gray, READY_WITHIN_S)
        picture = browser.picture().astype(int)
        colorful = np.ptp(picture, -1) > 60
        assert colorful[:, :600].mean() > 0.1
        assert browser.complaints == []
    finally:
        viewer.stop()


@pytest.mark.parametrize("width", [1280, 400])
def test_the_report_opens_whole_and_without_a_complaint(
    browser: Page, sphere_dataset: Dataset, tmp_path: Path, width: int
) -> None:
    """On a wide and on a narrow screen: every picture is decoded, and nothing is wider than the window."""
    prediction = write_truth_prediction(tmp_path / "truth", sphere_dataset)
    evaluate(prediction)
    with served(tmp_path) as address:
        report = write_report(prediction).relative_to(tmp_path)
        browser.open(f"{address}/{report}", width, 800)
        browser.wait_until(lambda: browser.value("document.readyState === 'complete'"), READY_WITHIN_S)
        decoded = "[...document.images].map(image => image.complete && image.naturalWidth > 0)"
        found = browser.value(decoded)
        assert len(found) > 5
        assert all(found)
        assert browser.value("document.documentElement.scrollWidth") <= width
        assert len(np.unique(browser.picture().reshape(-1, 3), axis=0)) > 100
    assert [each for each in browser.complaints if "favicon" not in each] == []
