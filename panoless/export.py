"""A finished fit → the prediction folder that the evaluator reads, pictures of the decomposition, and a PLY."""

import json
import os
import platform
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from panoless import __version__
from panoless.checkpoint import FitState
from panoless.config import FitConfig
from panoless.cubemap import look_up
from panoless.fit import clear_views, complete, normalization_of
from panoless.kernels.cubemap import sample_cubemap
from panoless.kernels.rasterize import RasterCamera
from panoless.kernels.reference.rasterize import rotation_matrices
from panoless.lathe import Lathe, lathe_buffers
from panoless.lathe_render import mean_light
from panoless.light import light_of
from panoless.plane import Plane, plane_buffers
from panoless.shading import ALPHA_FLOOR, compose, reflection_directions_world, surface_buffers
from panoless.sheet import Sheet, sheet_buffers
from panoless.snapshots import read_snapshot, snapshot_folders
from panoless.surfels import Surfels
from panoless.views import Normalization, load_views, raster_camera, unit_rays_camera
from shinypartial.color import to_display
from shinypartial.dataset.schema import Dataset, View
from shinypartial.errors import InputError
from shinypartial.files import remove_partial_files, whole_file
from shinypartial.images import write_png
from shinypartial.picture_sheet import write_picture_sheet
from shinypartial.prediction import (
    DECOMPOSITION,
    DESCRIPTION,
    ENVIRONMENT,
    SNAPSHOTS,
    PredictionInfo,
    claim_prediction,
    dataset_hash,
    read_info,
    write_environment_map,
    write_info,
    write_test_view,
    write_visibility,
)
from shinypartial.progress import Progress
from shinypartial.sphere import latlong_directions

PLY_NAME = "surfels.ply"
PLANE_PLY_NAME = "plane.ply"
LATHE_PLY_NAME = "lathe.ply"
SHEET_PLY_NAME = "sheet.ply"
PICTURES = "pictures"
SUPERSAMPLING = 2
LATHE_AROUND = 128
SH_DEGREE_0 = 0.28209479177387814


@dataclass(frozen=True)
class Decomposition:
    """What a view is made of. Radiance and albedo are linear and premultiplied; normals are unit, world frame.

    `depth` is camera z-depth in scene units; depth and normals are zero where alpha is below 0.001.
    """

    radiance: Float[Tensor, "3 H W"]
    albedo: Float[Tensor, "3 H W"]
    specular: Float[Tensor, "3 H W"]
    alpha: Float[Tensor, "H W"]
    normals_world: Float[Tensor, "3 H W"]
    depth: Float[Tensor, "H W"]


def render(
    geometry: Surfels | Plane | Sheet | Lathe,
    environment: Float[Tensor, "6 3 L L"],
    camera: RasterCamera,
    normalization: Normalization,
    config: FitConfig,
) -> Decomposition:
    """Render one camera with the final environment (radiance, not logits) in a mirror of the configured tint."""
    with torch.no_grad():
        if isinstance(geometry, Plane):
            buffers = plane_buffers(geometry, camera)
        elif isinstance(geometry, Sheet):
            buffers = sheet_buffers(geometry, camera)
        elif isinstance(geometry, Lathe):
            buffers = lathe_buffers(geometry, camera)
        else:
            curved, depth_blend = config.surfels.curved, config.loss.depth_blend
            buffers = surface_buffers(geometry, camera, curved=curved, depth_blend=depth_blend)
        rotation = camera.world_to_camera[:3, :3].T
        pixels = torch.nonzero(buffers.alpha.flatten() > ALPHA_FLOOR)[:, 0]
        normals_camera = buffers.raster_normals_camera.flatten(1)[:, pixels]
        if isinstance(geometry, Lathe):
            light = mean_light(geometry, environment, camera, pixels)
        else:
            rays = unit_rays_camera(camera).flatten(1)[:, pixels]
            directions = reflection_directions_world(normals_camera, rays, rotation)
            light = look_up(environment, directions, "clamp")
        specular = torch.zeros_like(buffers.albedo)
        specular.flatten(1)[:, pixels] = light.T
        normals = torch.zeros_like(buffers.albedo)
        normals.flatten(1)[:, pixels] = rotation @ normalize(normals_camera, dim=0, eps=1e-8)
        tint = specular.new_tensor(config.tint)[:, None, None]
        return Decomposition(
            radiance=tint * compose(buffers.albedo, specular, buffers.alpha, config.alpha_applied),
            albedo=tint * buffers.albedo,
            specular=tint * specular,
            alpha=buffers.alpha,
            normals_world=normals,
            depth=buffers.surface_depth * normalization.radius * (buffers.alpha > ALPHA_FLOOR),
        )


def export_prediction(
    dataset: Dataset, state: FitState, config: FitConfig, folder: Path, *, snapshot: bool = False
) -> None:
    """Write environment, visibility, test views, pictures, PLY and, last, prediction.json.

    `snapshot` says that the state is not the end of its fit, and states its iteration. An earlier prediction.json is
    removed first, so that it never describes a mixture; `test` marks the folder as begun.
    """
    if state.final_environment is None or state.visibility is None:
        raise ValueError("only a finished fit can be exported")
    (folder / "test").mkdir(parents=True, exist_ok=True)
    (folder / DESCRIPTION).unlink(missing_ok=True)
    remove_partial_files(folder)
    environment = state.final_environment
    height = 2 * environment.shape[-1]
    write_environment_map(folder, cube_to_latlong(environment, height))
    write_visibility(folder, cube_to_latlong(state.visibility[:, None], height)[..., 0].clip(0, 1))
    geometry = state.geometry
    for name in (PLY_NAME, PLANE_PLY_NAME, SHEET_PLY_NAME, LATHE_PLY_NAME):
        (folder / name).unlink(missing_ok=True)
    if isinstance(geometry, Surfels):
        write_ply(folder / PLY_NAME, geometry, normalization_of(state))
    elif isinstance(geometry, Lathe):
        write_lathe_ply(folder / LATHE_PLY_NAME, geometry, normalization_of(state))
    elif isinstance(geometry, Sheet):
        write_sheet_ply(folder / SHEET_PLY_NAME, geometry, normalization_of(state))
    else:
        write_plane_ply(folder / PLANE_PLY_NAME, geometry, normalization_of(state))
    _write_test_views(dataset, state, config, folder)
    info = PredictionInfo(
        method=f"panoless {__version__} ({config.preset})",
        dataset=str(dataset.root.resolve()),
        dataset_hash=dataset_hash(dataset),
        config=asdict(config),
        seconds={name: round(value, 3) for name, value in state.seconds.items()},
        hardware={
            "processor": _processor_name(),
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "python": platform.python_version(),
            "torch": torch.__version__,
        },
        parameter_counts=_parameter_counts(state, config),
        peak_memory_bytes=state.peak_memory_bytes,
        curves=state.curves,
        primitives=state.surfels.count if isinstance(geometry, Surfels) else 1,
        model_bytes=sum((folder / name).stat().st_size for name in (_ply_name(state), ENVIRONMENT)),
        model=state.rung or None,
        iteration=state.iteration if snapshot else None,
    )
    write_info(folder, info)


def export_snapshots(dataset: Dataset, run: Path, config: FitConfig, prediction: Path) -> list[Path]:
    """Complete every snapshot of a run as the end of a fit is completed, and export it to PREDICTION/snapshots.

    Its `seconds` are those of the fit until the snapshot and those of solving its environment here. A snapshot that was
    exported already is kept. Returns the folders; raises InputError when the run has none.
    """
    found = snapshot_folders(run)
    if not found:
        raise InputError(
            expected=f"snapshots below {run}",
            found="none",
            remedy="Fit with `panoless fit --snapshots 6 --output NEW`.",
        )
    views = None
    for source in found:
        state, target = read_snapshot(source), prediction / SNAPSHOTS / source.name
        if _is_exported(target, state, config, dataset):
            continue
        if views is None:
            loaded = load_views(dataset, config.crop_margin_px, config.downscale, light_of(config))
            views = clear_views(loaded, state, config)
        complete(state, views, config)
        claim_prediction(target)
        export_prediction(dataset, state, config, target, snapshot=True)
    return [prediction / SNAPSHOTS / source.name for source in found]


def _is_exported(folder: Path, state: FitState, config: FitConfig, dataset: Dataset) -> bool:
    """Whether the folder describes this very snapshot; equal seconds to the millisecond tell fits apart."""
    if not (folder / DESCRIPTION).exists():
        return False
    info = read_info(folder)
    same_fit = info.config == json.loads(json.dumps(asdict(config))) and info.dataset_hash == dataset_hash(dataset)
    stages = {name: round(value, 3) for name, value in state.seconds.items()}
    return same_fit and info.iteration == state.iteration and stages.items() <= info.seconds.items()


def _write_test_views(dataset: Dataset, state: FitState, config: FitConfig, folder: Path) -> None:
    normalization = normalization_of(state)
    environment = state.final_environment
    assert environment is not None
    progress = Progress("exporting test views", len(dataset.test))
    for index, frame in enumerate(dataset.test):
        distance = np.linalg.norm(frame.camera.position_world - normalization.center) / normalization.radius
        camera = raster_camera(frame.camera, normalization, 0.1 * float(distance))
        parts = render(state.geometry, environment, camera, normalization, config)
        view = View(
            radiance=parts.radiance.permute(1, 2, 0).numpy(),
            alpha=parts.alpha.numpy(),
            normals_world=parts.normals_world.permute(1, 2, 0).numpy(),
            depth=parts.depth.numpy(),
            high_dynamic_range=True,
        )
        write_test_view(folder, frame, view)
        if index == len(dataset.test) // 2:
            pictures = _pictures(parts)
            for name, picture in pictures.items():
                write_png(folder / PICTURES / f"{name}.png", picture)
            write_picture_sheet(folder / DECOMPOSITION, _titled(pictures, parts.alpha))
        progress.advance()


def _pictures(parts: Decomposition) -> dict[str, np.ndarray]:
    """The decomposition of one test view: render, specular, albedo, normals, depth and alpha."""

    def image(tensor: Tensor) -> np.ndarray:
        return tensor.permute(1, 2, 0).contiguous().numpy()

    covered = parts.alpha > 0.5
    depth = parts.depth[covered]
    near, far = (float(depth.min()), float(depth.max())) if len(depth) else (0.0, 1.0)
    nearness = torch.where(covered, 1 - 0.9 * (parts.depth - near) / max(far - near, 1e-9), torch.zeros(()))
    return {
        "1-render": to_display(image(parts.radiance)),
        "2-specular": to_display(image(parts.specular * parts.alpha)),
        "3-albedo": to_display(image(parts.albedo)),
        "4-normals": np.rint((image(parts.normals_world) + 1) / 2 * 255 * image(covered[None].float())).astype(
            np.uint8
        ),
        "5-depth-near-is-bright": np.rint(nearness.clamp(0, 1).numpy() * 255).astype(np.uint8),
        "6-alpha": np.rint(parts.alpha.clamp(0, 1).numpy() * 255).astype(np.uint8),
    }


def _titled(pictures: dict[str, np.ndarray], alpha: Tensor) -> dict[str, np.ndarray]:
    """The pictures around the object with a twelfth of margin, under their names without numbers."""
    rows, columns = (torch.nonzero(alpha.amax(axis) > ALPHA_FLOOR)[:, 0] for axis in (1, 0))
    if len(rows) == 0:
        rows, columns = (torch.arange(size) for size in alpha.shape)
    margin = max(len(rows), len(columns)) // 12
    window = tuple(slice(max(0, int(x.min()) - margin), int(x.max()) + 1 + margin) for x in (rows, columns))
    return {name.split("-", 1)[1].replace("-", " "): picture[window] for name, picture in pictures.items()}


def cube_to_latlong(cube: Float[Tensor, "6 C L L"], height: int) -> Float[np.ndarray, "H 2*H C"]:
    """Area-averaged lat-long map of a cubemap: seamless lookups at 2×2 points a texel."""
    fine = latlong_directions(height * SUPERSAMPLING).reshape(-1, 3)
    values = sample_cubemap(cube, torch.from_numpy(fine).to(torch.float32)).numpy()
    blocks = values.reshape(height, SUPERSAMPLING, 2 * height, SUPERSAMPLING, -1)
    return blocks.mean((1, 3))


def write_ply(path: Path, surfels: Surfels, normalization: Normalization) -> None:
    """Write surfels in world units as binary PLY with the property names that Gaussian-splat viewers read.

    Colors are degree-0 spherical harmonics of the albedo; curvature_a, _b, _c are the shape operator.
    """
    world = surfels.detached()
    normals = rotation_matrices(world.quats)[:, :, 2]
    columns = {
        **_columns("xyz", world.means * normalization.radius + torch.from_numpy(normalization.center).float()),
        **_columns(("nx", "ny", "nz"), normals),
        **_columns(("f_dc_0", "f_dc_1", "f_dc_2"), (world.albedo - 0.5) / SH_DEGREE_0),
        "opacity": world.opacity_logits.numpy(),
        **_columns(("scale_0", "scale_1"), world.log_scales + float(np.log(normalization.radius))),
        **_columns(("rot_0", "rot_1", "rot_2", "rot_3"), normalize(world.quats, dim=1)),
        **_columns(("curvature_a", "curvature_b", "curvature_c"), world.curvatures / normalization.radius),
    }
    table = np.zeros(world.count, dtype=[(name, "<f4") for name in columns])
    for name, column in columns.items():
        table[name] = column
    properties = "".join(f"property float {name}\n" for name in columns)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {world.count}\n{properties}end_header\n"
    with whole_file(path) as temporary:
        temporary.write_bytes(header.encode("ascii") + table.tobytes())


def write_plane_ply(path: Path, plane: Plane, normalization: Normalization) -> None:
    """Write the plane in world units as an ASCII PLY of one polygon."""
    corners = plane.points(plane.outline) * normalization.radius + normalization.center
    lines = ["ply", "format ascii 1.0", f"element vertex {len(corners)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(f"{value:.9g}" for value in corner) for corner in corners]
    lines.append(" ".join(map(str, [len(corners), *range(len(corners))])))
    with whole_file(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="ascii")


def write_lathe_ply(path: Path, lathe: Lathe, normalization: Normalization) -> None:
    """Write the surface of revolution in world units as an ASCII PLY of quadrilaterals, 128 around."""
    rings = lathe.rings(LATHE_AROUND) * normalization.radius + normalization.center
    count, around = rings.shape[:2]
    index = np.arange(count * around).reshape(count, around)
    following = np.roll(index, -1, 1)
    faces = np.stack([index[:-1], following[:-1], following[1:], index[1:]], -1).reshape(-1, 4)
    _write_quadrilaterals(path, rings.reshape(-1, 3), faces)


def write_sheet_ply(path: Path, sheet: Sheet, normalization: Normalization) -> None:
    """Write the bent plane in world units as an ASCII PLY of quadrilaterals, those within the outline."""
    points, faces = sheet.quadrilaterals()
    _write_quadrilaterals(path, points * normalization.radius + normalization.center, faces)


def _write_quadrilaterals(path: Path, points: Float[np.ndarray, "P 3"], faces: Int[np.ndarray, "F 4"]) -> None:
    lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(f"{value:.9g}" for value in corner) for corner in points]
    lines += ["4 " + " ".join(map(str, face)) for face in faces.tolist()]
    with whole_file(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="ascii")


def _ply_name(state: FitState) -> str:
    names = {Lathe: LATHE_PLY_NAME, Sheet: SHEET_PLY_NAME, Plane: PLANE_PLY_NAME, Surfels: PLY_NAME}
    return names[type(state.geometry)]


def _columns(names: str | tuple[str, ...], matrix: Tensor) -> dict[str, np.ndarray]:
    return {name: matrix[:, index].numpy() for index, name in enumerate(names)}


def _parameter_counts(state: FitState, config: FitConfig) -> dict[str, int]:
    """Numbers that the fit may choose, by what they belong to."""
    assert state.final_environment is not None
    geometry, environment = state.geometry, {"environment parameters": state.final_environment.numel()}
    if not isinstance(geometry, Surfels):
        kinds = {Plane: "plane", Sheet: "bent plane", Lathe: "revolution"}
        return {f"{kinds[type(geometry)]} parameters": geometry.numbers, **environment}
    per_surfel = 3 + 4 + 2 + 1
    per_surfel += 3 * config.albedo + 3 * config.surfels.curved + config.loss.roughness_weighted
    return {"surfel parameters": per_surfel * geometry.count, **environment}


def _processor_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
