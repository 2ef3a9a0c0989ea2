"""Path tracing of chosen pixels alone: packed into a small image by a ray portal before the camera.

The scene is the main one with a plane before the camera. Each pixel of the small image stands for one pixel of the
view; the plane moves its rays to where the rays of that pixel run. Cycles samples a pixel of the small image as it does
any other, so every pass has the value that a render of the whole view has there, but for noise.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.blender.materials import image_of
from shinypartial.blender.passes import PASSES, read_passes
from shinypartial.core.camera import Camera, project

SPARSE, PORTAL, PIXELS = "sparse pixels", "portal", "places of sparse pixels"
#: The plane's distance, and that at which rays go on, as shares of the nearest surface's depth.
PLANE_SHARE, EXIT_SHARE = 0.3, 0.45


def assemble_sparse(bpy: Any) -> None:
    """Add the scene: everything of the open one, linked, and the plane."""
    main = bpy.context.scene
    scene = main.copy()
    scene.name = SPARSE
    mesh = bpy.data.meshes.new(PORTAL)
    mesh.from_pydata([(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)], [], [(0, 1, 2, 3)])
    mesh.materials.append(bpy.data.materials.new(PORTAL))
    plane = bpy.data.objects.new(PORTAL, mesh)
    plane.parent = main.camera
    scene.collection.objects.link(plane)
    for kind in ("diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
        setattr(plane, f"visible_{kind}", False)
    _send_rays_on(mesh.materials[0])


def nearest_depth(camera: Camera, vertices_world: Float[np.ndarray, "P 3"]) -> float:
    """That of the vertex closest to the camera's plane."""
    return float(project(camera, vertices_world)[:, 2].min())


def render_sparse(
    bpy: Any, path: Path, chosen: Bool[np.ndarray, "H W"], depth: float
) -> dict[str, Float[np.ndarray, "P"]]:
    """Passes of the chosen pixels, row by row, of the camera's present view; nothing lies nearer than `depth`."""
    rows, columns = np.nonzero(chosen)
    width = int(np.ceil(np.sqrt(len(rows))))
    height = -(-len(rows) // width)
    scene = bpy.data.scenes[SPARSE]
    scene.render.use_border = False
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.objects[PORTAL].location = (0, 0, -PLANE_SHARE * depth)
    scene.objects[PORTAL].scale = (PLANE_SHARE * depth,) * 3
    places = np.zeros((height * width, 4), np.float32)
    places[: len(rows), 0], places[: len(rows), 1] = columns, rows
    nodes = bpy.data.materials[PORTAL].node_tree.nodes
    # Cycles knows images by their address: the one before may go only when this one has another.
    before, nodes["places"].image = nodes["places"].image, image_of(bpy, PIXELS, places.reshape(height, width, 4))
    if before:
        bpy.data.images.remove(before)
    nodes["size"].inputs[1].default_value = (width, height, 0)
    # Camera axes of Blender: +y up, −z forward; the ray (x, y, −1) in the plane's units.
    lens, (view_height, view_width) = scene.camera.data, chosen.shape
    slope = lens.sensor_width / (lens.lens * view_width)
    nodes["ray"].inputs[1].default_value = (slope, -slope, 0)
    nodes["ray"].inputs[2].default_value = (-slope * view_width / 2, slope * view_height / 2, -1)
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True, scene=SPARSE)
    return {name: channel.ravel()[: len(rows)] for name, channel in read_passes(path, PASSES).items()}


def _send_rays_on(material: Any) -> None:
    """Shader of the plane, whose frame is the camera's, moved and scaled so that the camera is at (0, 0, 1).

    On the small image, (x, y) from the lower left in its pixels, the integer part says which pixel of the view is meant
    and the fraction where in it the ray goes through: at column + x, row + 1 − y of the view. `render_sparse` fills in
    the nodes that have names.
    """
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()

    def vector(operation: str, *inputs: Any) -> Any:
        node = nodes.new("ShaderNodeVectorMath")
        node.operation = operation
        for socket, value in zip(node.inputs, inputs, strict=False):
            if isinstance(value, tuple):
                socket.default_value = value
            else:
                links.new(value, socket)
        return node

    def to_world(kind: str, local: Any) -> Any:
        node = nodes.new("ShaderNodeVectorTransform")
        node.vector_type, node.convert_from, node.convert_to = kind, "OBJECT", "WORLD"
        links.new(local, node.inputs["Vector"])
        return node.outputs["Vector"]

    window = nodes.new("ShaderNodeTexCoord").outputs["Window"]
    places = nodes.new("ShaderNodeTexImage")
    places.name, places.interpolation, places.extension = "places", "Closest", "EXTEND"
    links.new(window, places.inputs["Vector"])
    size = vector("MULTIPLY", window, (1.0, 1.0, 0.0))
    size.name = "size"
    within = vector("FRACTION", size.outputs["Vector"]).outputs["Vector"]
    downward = vector("MULTIPLY_ADD", within, (1.0, -1.0, 0.0), (0.0, 1.0, 0.0)).outputs["Vector"]
    pixel = vector("ADD", places.outputs["Color"], downward).outputs["Vector"]
    to_ray = vector("MULTIPLY_ADD", pixel)
    to_ray.name, ray = "ray", to_ray.outputs["Vector"]
    reach = EXIT_SHARE / PLANE_SHARE
    exit_point = vector("MULTIPLY_ADD", ray, (reach,) * 3, (0.0, 0.0, 1.0)).outputs["Vector"]
    portal = nodes.new("ShaderNodeBsdfRayPortal")
    links.new(to_world("POINT", exit_point), portal.inputs["Position"])
    links.new(vector("NORMALIZE", to_world("VECTOR", ray)).outputs["Vector"], portal.inputs["Direction"])
    links.new(portal.outputs["BSDF"], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
