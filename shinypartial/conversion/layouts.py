"""Where other methods' code leaves its results and how it encodes them, as data: one entry a method.

Every entry names the file and the commit that define it; docs/how-to/compare-methods.md lists the commits.
"""

from dataclasses import dataclass, replace
from typing import Literal

Axis = tuple[float, float, float]
LayoutName = Literal["3dgs-dr", "ref-gaussian", "materialrefgs", "gaussianshader", "panoless-paper"]
#: Public sets of photographs, which `conversion.captures` reads.
CaptureLayout = Literal["stanford-orb", "objects-with-lighting"]
AxisName = Literal["+X", "-X", "+Y", "-Y", "+Z", "-Z"]


@dataclass(frozen=True)
class Grid:
    """How a lat-long picture of H×W texels lies in the dataset's world.

    Texel (row i, column j) shows the direction sin θ (cos φ · forward + sin φ · right) + cos θ · up with

        θ = π (t + (H − t − b) i / (H − 1)) / H,  φ = 2π (l + (W − l − r) j / (W − 1)) / W − π,

    (t, b) being `rows` and (l, r) `columns`: how far the first and the last texel's centers lie from the edges of the
    sphere's chart, in texels: ½ and ½ where texels tile the chart, 0 and 0 where the last column repeats the first.
    l + r is 0 or 1.
    """

    forward: Axis
    """What the middle of the picture shows, in the world."""
    right: Axis
    """What lies a quarter of the width to its right."""
    up: Axis
    """What the first row shows."""
    rows: tuple[float, float]
    columns: tuple[float, float]


@dataclass(frozen=True)
class Layout:
    """The files of one method, by paths below its output folder, with `{iteration}` and the number of the `{view}`."""

    method: str
    """Name for reports."""
    environment: str
    """Light in 8-bit codes or, as HDR, in floating point: of sRGB, unless `linear_argument` was given."""
    environment_grid: Grid
    renders: str
    """Test views in sRGB, over the background that `cfg_args` states, or times `masks` where it has these."""
    normals: str
    """(n + 1)/2 of world normals in 8 bits, times `masks` where it has these."""
    masks: str | None = None
    """Coverage in 8 bits. None: it writes none that can be read, and the dataset's masks cut out its test views."""
    photographs: str | None = None
    """The photograph of each number, which determines the view; None: numbers follow `transforms_test.json`."""
    visibility: str | None = None
    """How well directions were seen, 0 to 1 in 8 bits."""
    visibility_grid: Grid | None = None
    linear_argument: str | None = None
    """A flag in `cfg_args` with which the light is linear."""
    model: tuple[str, ...] = ("point_cloud/iteration_{iteration}/point_cloud.ply",)
    """What a renderer needs; every PLY has a vertex a primitive."""


X, Y, Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)
#: linspace(−π, π, W) by linspace(0, π, H) about the world's Z: mirrored against the dataset's maps, ends repeated.
ENDPOINTS = Grid(forward=X, right=Y, up=Z, rows=(0, 0), columns=(0, 0))
#: nvdiffrec's Y-up chart, looked up in the world's axes as they are: the first row shows the world's +Y. Its rows run
#: from 1/H to 1 − 1/H and thus end a whole texel from the poles.
NVDIFFREC = Grid(forward=(0, 0, -1), right=X, up=Y, rows=(1, 1), columns=(0.5, 0.5))
#: Columns at j/W, rows at i/(H − 1), about the world's Z.
USAGE = Grid(forward=X, right=Y, up=Z, rows=(0, 0), columns=(0, 1))

_REF_GAUSSIAN = Layout(
    # fudan-zvg/ref-gaussian at af7691a: eval.py, gaussian_renderer/__init__.py, scene/gaussian_model.py and light.py.
    method="Ref-Gaussian",
    environment="env2.png",
    environment_grid=ENDPOINTS,
    renders="test/renders/rgb/{view:05d}.png",
    normals="test/renders/normal/{view:05d}.png",
    linear_argument="srgb",
    model=(
        "point_cloud/iteration_{iteration}/point_cloud.ply",
        "point_cloud/iteration_{iteration}/point_cloud1.map",
    ),
)

#: By the name that the command takes.
LAYOUTS: dict[LayoutName, Layout] = {
    # gapszju/3DGS-DR at e285f6b: eval.py, scene/gaussian_model.py, gaussian_renderer/__init__.py,
    # utils/general_utils.py.
    "3dgs-dr": Layout(
        method="3DGS-DR",
        environment="light1.png",
        environment_grid=ENDPOINTS,
        renders="test/ours_{iteration}/renders/rgb/{view:05d}.png",
        normals="test/ours_{iteration}/renders/normal/{view:05d}.png",
        model=(
            "point_cloud/iteration_{iteration}/point_cloud.ply",
            "point_cloud/iteration_{iteration}/point_cloud.map",
        ),
    ),
    "ref-gaussian": _REF_GAUSSIAN,
    # wen-yuan-zhang/MaterialRefGS at 280edee: the same files under the same names, and Gaussians of the surroundings.
    "materialrefgs": replace(
        _REF_GAUSSIAN,
        method="MaterialRefGS",
        model=(*_REF_GAUSSIAN.model, "point_cloud/iteration_{iteration}/env_point_cloud.ply"),
    ),
    # Asparagus15/GaussianShader at de77861: render.py, scene/__init__.py, scene/NVDIFFREC/util.py and light.py.
    "gaussianshader": Layout(
        method="GaussianShader",
        environment="brdf_mlp/iteration_{iteration}/brdf_mlp.hdr",
        environment_grid=NVDIFFREC,
        renders="test/ours_{iteration}/renders/{view:05d}.png",
        normals="test/ours_{iteration}/normal/{view:05d}.png",
        model=(
            "point_cloud/iteration_{iteration}/point_cloud.ply",
            "brdf_mlp/iteration_{iteration}/brdf_mlp.hdr",
        ),
    ),
    # vb-glee/panoless at 8d782d9: train.py, gaussian_renderer/__init__.py, utils/general_utils.py,
    # scene/gaussian_model.py, submodules/cubemapencoder/cubemapencoder/cubemap_encoder.py.
    "panoless-paper": Layout(
        method="PanoLess (paper)",
        environment="envmap_env_cood1_{iteration:06d}.png",
        environment_grid=ENDPOINTS,
        renders="iteration-{iteration}/pbr_rgb/pbr_rgb_{view:03d}.png",
        normals="iteration-{iteration}/render_normal/render_normal_{view:03d}.png",
        masks="iteration-{iteration}/render_alpha/render_alpha_{view:03d}.png",
        photographs="iteration-{iteration}/gt_image/gt_image_{view:03d}.png",
        visibility="envmap_env_usage_{iteration:06d}.png",
        visibility_grid=USAGE,
        model=(
            "point_cloud/iteration_{iteration}/point_cloud.ply",
            "point_cloud/iteration_{iteration}/envmap.pth",
        ),
    ),
}
