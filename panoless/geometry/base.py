"""What any mirror can do, and how a kind of mirror is proposed from silhouettes and fitted."""

import weakref
from collections.abc import Callable, Collection, Iterator, MutableMapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from typing import Any, ClassVar, Protocol, TypeVar, get_args, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize
from torch.utils.weak import WeakIdKeyDictionary

from panoless.capture.corrections import Corrections
from panoless.capture.object_frame import ObjectFrame
from panoless.capture.poses import Poses
from panoless.capture.rays import pixel_rays, pose_of, unit_rays_camera
from panoless.capture.views import TrainView, Views, at_most_pixels
from panoless.config import FitConfig
from panoless.environment.footprints import Footprints, PixelFootprints
from panoless.environment.rays import Rays
from panoless.environment.reflectance import Reflectance
from panoless.environment.surroundings import Surroundings
from panoless.kernels.camera import RasterCamera
from panoless.problem.blocks import Block
from panoless.problem.evidence import Decision
from panoless.problem.observations import silhouette_rays
from panoless.problem.parametric import ParametricSurface

Numbers = TypeVar("Numbers")
SOLID_SURFACE_ALPHA = 0.9
"""A pixel with more alpha than this shows the surface."""
SAMPLES = 4
"""Rays along a side of a pixel at a silhouette, for its alpha, and of every pixel, for its mean light."""
MERIDIANS, RINGS = 128, 64
_last_usable: MutableMapping["Geometry", tuple[Callable[[], Views | None], Views]] = WeakIdKeyDictionary()
"""The views that were requested last, and the answer."""


@dataclass(frozen=True)
class SurfaceBuffers:
    """What one camera sees of a surface. All is zero where alpha is.

    `normals_camera` is alpha times the normal in camera axes; `depth` is camera z-depth in the object frame, Eq. 3 for
    surfels; `albedo` is unshaded diffuse radiance, premultiplied.
    """

    alpha: Float[Tensor, "H W"]
    normals_camera: Float[Tensor, "3 H W"]
    depth: Float[Tensor, "H W"]
    albedo: Float[Tensor, "3 H W"]

    def cosines(self, camera: RasterCamera) -> Float[Tensor, "H W"]:
        """cos θ of the angle of incidence at the pixels' centers, in [0, 1]; 1 where `camera` sees no surface."""
        rays = unit_rays_camera(camera, self.alpha.device)
        cosines = -(normalize(self.normals_camera, dim=0) * rays).sum(0)
        return torch.where(self.alpha > 0, cosines.clamp(0, 1), 1.0)

    def points(self, camera: RasterCamera, pixels: Int[Tensor, "P"]) -> Float[Tensor, "P 3"]:
        """Where pixels (flat indices) of `camera` see the surface, in the normalized frame."""
        rays = unit_rays_camera(camera, self.depth.device).flatten(1)[:, pixels]
        points_camera = rays / rays[2] * self.depth.flatten()[pixels]
        to_camera = camera.world_to_camera
        return (points_camera - to_camera[:3, 3:]).T @ to_camera[:3, :3]

    def shown(
        self, reflectance: Reflectance, camera: RasterCamera, pixels: Int[Tensor, "P"]
    ) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
        """The share of the light that a surface of that reflectance mirrors, and what it scatters, at pixels of
        `camera`.
        """
        normals = normalize(self.normals_camera.flatten(1)[:, pixels], dim=0).T @ camera.world_to_camera[:3, :3]
        points = None if reflectance.field is None else self.points(camera, pixels)
        return reflectance.shown(self.cosines(camera).flatten()[pixels], normals, points)


def beside_silhouette(met: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Pixels among whose eight neighbors and themselves some hit a surface and some miss it."""
    from scipy.ndimage import maximum_filter, minimum_filter

    found: np.ndarray = maximum_filter(met, 3, mode="nearest") & ~minimum_filter(met, 3, mode="nearest")
    return found


def overlap(alpha: Float[Tensor, "H W"], mask: Float[Tensor, "H W"]) -> float:
    """Intersection over union, Σ min / Σ max; zero where both are empty."""
    return float(alpha.minimum(mask).sum() / alpha.maximum(mask).sum().clamp(min=1e-9))


def buffers_from_arrays(
    alpha: Float[np.ndarray, "H W"],
    depth: Float[np.ndarray, "H W"],
    normals_camera: Float[np.ndarray, "3 #H #W"],
    camera: RasterCamera,
) -> SurfaceBuffers:
    """Coverage in [0, 1], depth along the camera's axis and unit normals in camera axes, as buffers without albedo.

    All is float32 on the device of the camera.
    """
    covered, distance, normals = (
        torch.from_numpy(np.ascontiguousarray(values)).float().to(camera.world_to_camera.device)
        for values in (alpha, depth, normals_camera)
    )
    return SurfaceBuffers(covered, normals * covered, distance, covered.new_zeros(3, *covered.shape))


@dataclass(frozen=True)
class RayHits:
    """First points of rays on a surface; the nearest points of rays that miss it."""

    met: Bool[np.ndarray, "P"]
    points: Float[np.ndarray, "P 3"]
    normals: Float[np.ndarray, "P 3"]
    """Unit, outward."""


@runtime_checkable
class ClosedForm(Protocol):
    """A surface with ray hits in closed form."""

    @property
    def surroundings(self) -> Surroundings:
        """What it mirrors."""
        ...

    def hits(self, origins: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"]) -> RayHits:
        """The first hit of every ray; directions of any length."""
        ...


def buffers_by_hits(surface: ClosedForm, camera: RasterCamera, samples: int = SAMPLES) -> SurfaceBuffers:
    """Depth and normals of rays through pixel centers; alpha the share of `samples`² rays that hit, at the silhouette.

    Where only the center misses, depth and normal are those of where its ray comes nearest.
    """
    shape, (rotation, center) = (camera.height, camera.width), pose_of(camera)
    everything = np.arange(camera.height * camera.width)
    hits = surface.hits(*pixel_rays(camera, everything))
    alpha = hits.met.astype(np.float64)
    mixed = np.flatnonzero(beside_silhouette(hits.met.reshape(shape)))
    parts = [surface.hits(*pixel_rays(camera, mixed, place)).met for place in parts_of_pixel(samples)]
    alpha[mixed] = np.stack(parts, 1).mean(1)
    covered = alpha > 0
    depth = ((hits.points - center) @ rotation[2]) * covered
    normals = (hits.normals * covered[:, None]) @ rotation.T
    return buffers_from_arrays(alpha.reshape(shape), depth.reshape(shape), normals.T.reshape(3, *shape), camera)


def parts_of_pixel(samples: int) -> list[tuple[float, float]]:
    """The middles of the parts of a pixel, so many along a side."""
    return [((i + 0.5) / samples, (j + 0.5) / samples) for j, i in np.ndindex(samples, samples)]


@dataclass(frozen=True)
class Mesh:
    """A surface as a file holds it, in world units: vertices with named columns beside x, y, z, and polygons."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F N"] | None = None
    """Indices of the vertices of every face, counterclockwise from outside; None for a cloud of points."""
    columns: dict[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def smooth(
        cls, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F N"], normals_world: Float[np.ndarray, "V 3"]
    ) -> "Mesh":
        """A surface with the unit normals of its vertices as columns nx, ny, nz."""
        return cls(vertices, faces, dict(zip(("nx", "ny", "nz"), normals_world.T, strict=True)))

    @staticmethod
    def unit_sphere() -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 4"]]:
        """Vertices and quadrilaterals between 128 meridians and 64 rings of ‖u‖ = 1; triangles' worth at the poles."""
        polar, turn = np.pi * np.arange(RINGS + 1) / RINGS, 2 * np.pi * np.arange(MERIDIANS) / MERIDIANS
        across, up = np.sin(polar)[:, None], np.cos(polar)[:, None] + 0 * turn
        vertices = np.stack([across * np.cos(turn), across * np.sin(turn), up], -1).reshape(-1, 3)
        index = np.arange(len(vertices)).reshape(RINGS + 1, MERIDIANS)
        upper, lower = index[:-1], index[1:]
        return vertices, np.stack([upper, lower, np.roll(lower, -1, 1), np.roll(upper, -1, 1)], -1).reshape(-1, 4)


@runtime_checkable
class Geometry(Protocol):
    """A mirror of one kind in the object frame, and how rays meet it. It is immutable."""

    kind: ClassVar[str]

    @property
    def num_parameters(self) -> int:
        """How many numbers it is made of."""
        ...

    @property
    def num_primitives(self) -> int:
        """Of how many primitives it consists."""
        ...

    @property
    def poses(self) -> Poses | None:
        """How the training views are turned and shifted against what is said of them; None: they are fixed."""
        ...

    def with_poses(self, poses: Poses | None) -> "Geometry":
        """The same surface with the cameras there."""
        ...

    @property
    def reflectance(self) -> Reflectance | None:
        """That with which the shape was solved; None: as a perfect mirror's."""
        ...

    def corrected(self, views: Views) -> Views:
        """The views with their cameras where the poses have them; as they are where they are fixed."""
        ...

    @property
    def surroundings(self) -> Surroundings:
        """How far away it takes what it mirrors to be."""
        ...

    def in_surroundings(self, surroundings: Surroundings) -> "Geometry":
        """The same surface there; itself where the kind knows only far ones."""
        ...

    def usable_pixels(self, view: TrainView) -> Int[Tensor, "P"]:
        """Those of the solid pixels of a view (flat indices) that show the surroundings, not the object again."""
        ...

    def observe(self, view: TrainView, pixels: Int[Tensor, "P"]) -> Rays:
        """What pixels of a view observed of the environment: reflected directions and radiance."""
        ...

    def footprints(self, views: Views, max_pixels: int) -> Footprints | None:
        """Directions over the areas of pixels, for a map that knows of them; None: a pixel is its center. A kind that
        traces each of them takes no more than about `max_pixels`.
        """
        ...

    def solve_map(self, views: Views, config: FitConfig) -> tuple[Float[Tensor, "6 3 L L"], list[Rays]]:
        """The closed-form map, in the encoding of the views, and the rays that it was solved from."""
        ...

    def buffers(self, camera: RasterCamera) -> SurfaceBuffers:
        """What a camera sees of the surface."""
        ...

    def shade(
        self,
        environment: Float[Tensor, "6 3 L L"],
        camera: RasterCamera,
        pixels: Int[Tensor, "P"],
        normals_camera: Float[Tensor, "3 P"],
    ) -> Float[Tensor, "P 3"]:
        """The specular radiance of pixels (flat indices) whose blended normals are given."""
        ...

    def mesh(self, frame: ObjectFrame) -> Mesh:
        """The surface in world units."""
        ...

    def to(self, device: torch.device) -> "Geometry":
        """The same numbers on a device, as far as they are tensors."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """All numbers as tensors, lists and plain values, which torch reads without running code."""
        ...

    @classmethod
    def from_state_dict(cls, content: dict[str, Any]) -> "Geometry":
        """The geometry that `state_dict` was taken from."""
        ...


@dataclass(frozen=True)
class Proposal:
    """A shape from silhouettes alone, and how well it explains them: medians over views."""

    shape: Any
    """What the kind's fit starts from."""
    silhouette_px: float
    """Distance of the mask's contour from that of the shape; infinite where no view sees it."""
    overlap: float
    """Intersection of shape and mask over their union, in [0, 1]."""

    def in_surroundings(self, surroundings: Surroundings) -> "Proposal":
        """The same shape there, for a kind that knows near surroundings."""
        return replace(self, shape=placed(self.shape, surroundings))

    @classmethod
    def of(cls, views: Views, shape: ClosedForm, unknowns: ParametricSurface) -> "Proposal":
        """A shape with medians over the views: distance of contours from its silhouette (px), overlap with masks."""
        rays = silhouette_rays(views, longest_only=True)
        away = np.abs(unknowns.silhouette(rays).pixels)
        medians = [np.median(away[rays.view == view]) for view in np.unique(rays.view)]
        overlaps = [overlap(buffers_by_hits(shape, view.camera).alpha.to(view.mask), view.mask) for view in views.train]
        return cls(shape, float(np.median(medians)), float(np.median(overlaps)))


def placed(shape: Any, surroundings: Surroundings) -> Any:
    """A shape in other surroundings, of its own or of the plane that it lies over."""
    if hasattr(shape, "plane"):
        return replace(shape, plane=placed(shape.plane, surroundings))
    return replace(shape, surroundings=surroundings)


Propose = Callable[[Views], Proposal | None]
"""Of views: a shape by their silhouettes."""


@runtime_checkable
class Family(Protocol):
    """A kind of geometry as a candidate in model selection."""

    kind: ClassVar[str]
    geometry: ClassVar[type[Geometry]]
    label: ClassVar[str]
    """With its article, as sentences name it."""
    refines: ClassVar[str | None]
    """The kind whose proposal it starts from where that one is not chosen; None: it makes its own."""
    in_few_steps: ClassVar[bool]
    """Whether the kind that it refines is compared with it, fitted in few steps."""
    needs_depth: ClassVar[bool]
    """Whether views have to come from different directions, which determine how far away the object is."""
    silhouettes_suffice: ClassVar[bool]
    """Whether silhouettes determine the whole shape, so that what photographs leave unexplained is no doubt of it but
    noise, or who holds the camera."""

    def propose(self, views: Views, config: FitConfig, *, requested: bool) -> Proposal | None:
        """A shape that explains the silhouettes; None where they determine none.

        Raises InputError in that case when the kind was `requested`.
        """
        ...

    def proposed_over(
        self, views: Views, proposal: Proposal, config: FitConfig, *, requested: bool = False
    ) -> Proposal | None:
        """Of a kind that refines another, the proposal that starts from the other's; None without one."""
        ...

    def as_proposed(self, proposal: Proposal, config: FitConfig) -> Geometry:
        """A proposal as a geometry, which shows what is wrong with cameras and masks."""
        ...

    def before_steps(self, views: Views, proposal: Proposal, config: FitConfig) -> Geometry:
        """The shape that a fit takes its first step from, which determines how near the surroundings are."""
        ...

    def refitted(self, views: Views, fitted: Any, config: FitConfig) -> Geometry:
        """A geometry of the kind after few more steps, in other surroundings or with views that changed a little."""
        ...

    def solve(
        self,
        views: Views,
        proposal: Proposal,
        kinds: Collection[type[Block]],
        required: Collection[str],
        config: FitConfig,
        propose: Propose,
    ) -> tuple[Geometry, Corrections, list[Decision]]:
        """The geometry with nuisance blocks of those kinds, what these correct, and which of them the scene needs;
        those that are `required` stay in any case. `propose` makes a proposal of corrected views.
        """
        ...

    def poses_by_silhouettes(
        self, views: Views, proposal: Proposal, kinds: Collection[type[Block]], config: FitConfig
    ) -> Poses:
        """Poses of cameras by silhouettes alone."""
        ...


def to_plain(value: Any) -> Any:
    """A dataclass of numbers and arrays as dictionaries, lists and numbers."""
    if is_dataclass(value):
        return {item.name: to_plain(getattr(value, item.name)) for item in fields(value)}
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def from_plain(cls: type[Numbers], content: dict[str, Any]) -> Numbers:
    """The dataclass of that class from `to_plain`; lists become arrays, and what is missing has its default."""
    values: dict[str, Any] = {}
    for item in fields(cls):  # type: ignore[arg-type]
        if item.name not in content and not (item.default is item.default_factory is MISSING):
            continue
        value = content[item.name]
        nested = [kind for kind in (item.type, *get_args(item.type)) if is_dataclass(kind)]
        if nested and value is not None:
            value = from_plain(nested[0], value)  # type: ignore[arg-type]
        values[item.name] = np.array(value) if isinstance(value, list) else value
    return cls(**values)


def poses_from_plain(content: dict[str, Any]) -> Poses | None:
    """The poses in what a `state_dict` became; None where there are none, or a version before knew of none."""
    found = content.get("poses")
    return None if found is None else from_plain(Poses, found)


def usable_views(views: Views, geometry: Geometry) -> Views:
    """The views with their cameras as a geometry has them, and its usable pixels as their solid ones.

    The last answer for each geometry is kept, because selection, map and verdict require pixels of the same views.
    """
    last = _last_usable.get(geometry)
    if last is not None and last[0]() is views:
        return last[1]
    posed = geometry.corrected(views)
    clear = tuple(replace(view, solid=geometry.usable_pixels(view)) for view in posed.train)
    found = replace(posed, train=clear)
    _last_usable[geometry] = weakref.ref(views), found
    return found


def observe_views(views: Views, geometry: Geometry, max_rays: int) -> Iterator[Rays]:
    """What solid pixels observed, at most `max_rays` of them, a batch a view."""
    for view, pixels in at_most_pixels(views, max_rays):
        yield geometry.observe(view, pixels)


def pixel_areas(views: Views, geometry: Geometry, max_rays: int) -> list[PixelFootprints]:
    """What solid pixels saw as means over their areas, of pixels that see the environment smoothly; of kinds without
    areas their centers, at most `max_rays` of them.
    """
    footprints = geometry.footprints(views, max_rays)
    if footprints is not None:
        return footprints.widened(views.blur_px).smooth
    return [PixelFootprints.centers(rays) for rays in observe_views(views, geometry, max_rays)]
