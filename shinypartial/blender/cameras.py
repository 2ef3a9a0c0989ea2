"""The camera of the open scene: its lens, its motion during the exposure, and the operator who holds it."""

import math
from typing import Any

import numpy as np

from shinypartial.blender.geometry import make_part
from shinypartial.blender.materials import make_light_material
from shinypartial.blender.mesh import joined
from shinypartial.blender.objects import mesh_of
from shinypartial.core.camera import Camera, opencv_to_opengl
from shinypartial.core.trajectory import CameraPath
from shinypartial.scene import Operator, Part, SceneSpec, Sphere

OPERATOR = "operator"
#: Cycles moves things along 2^(steps − 1) chords in place of the arc; of 30°, sixteen stray by 1.3e-4 of the radius.
MOTION_STEPS = 5


def add_camera(bpy: Any, scene: Any, spec: SceneSpec) -> None:
    """Link the camera, and the operator where there is one, to a pivot at the target that turns at a constant rate.

    Exposures are one frame long and the present frame, in which the pivot is at rest, is their middle.
    """
    pivot = bpy.data.objects.new("pivot", None)
    pivot.location = spec.camera.target
    camera = bpy.data.objects.new("camera", _lens(bpy, spec.camera))
    figures = [_figure(bpy, spec.operator, spec.render.exposure)] if spec.operator else []
    for each in (pivot, camera, *figures):
        scene.collection.objects.link(each)
    for each in (camera, *figures):
        each.parent = pivot
    scene.camera = camera
    if spec.camera.motion_deg:
        turn = pivot.driver_add("rotation_euler", 2).driver
        turn.expression = f"{math.radians(spec.camera.motion_deg)!r} * (frame - {scene.frame_current})"
        for each in (camera, *figures):
            each.cycles.motion_steps = MOTION_STEPS
        scene.render.use_motion_blur = True
        scene.render.motion_blur_position, scene.render.motion_blur_shutter = "CENTER", 1.0
    bpy.context.view_layer.update()


def set_view(bpy: Any, camera: Camera, spec: CameraPath) -> None:
    """Move the camera and the operator, who stays upright, and focus."""
    lens = bpy.context.scene.camera
    lens.matrix_world = opencv_to_opengl(camera.camera_to_world).T.tolist()
    to_target = np.array(spec.target) - camera.position_world
    depth = float(to_target @ camera.camera_to_world[:3, 2])
    lens.data.dof.focus_distance = spec.focus_distance or depth
    for each in operators(bpy):
        each.location = (-to_target).tolist()


def operators(bpy: Any) -> list[Any]:
    """The figure at the camera in every scene that has it."""
    return [each for each in bpy.data.objects if OPERATOR in each.name]


def _lens(bpy: Any, spec: CameraPath) -> Any:
    camera = bpy.data.cameras.new("camera")
    camera.type, camera.sensor_fit = "PERSP", "HORIZONTAL"
    camera.lens, camera.sensor_width = spec.lens_mm, spec.sensor_mm
    camera.clip_start, camera.clip_end = 1e-3 * spec.radius, 1e3 * spec.radius
    camera.dof.use_dof = spec.f_number is not None
    camera.dof.aperture_fstop = spec.f_number or camera.dof.aperture_fstop
    return camera


def _figure(bpy: Any, spec: Operator, exposure: float) -> Any:
    """Head about the origin and body below it; cameras see through both."""
    width, half_height = spec.body_radii
    below = (0.0, 0.0, -spec.head_radius - half_height)
    body = Part(Sphere(segments=64, rings=32), stretch=(width, width, half_height), offset=below)
    head = Part(Sphere(radius=spec.head_radius, segments=32, rings=16))
    mesh = mesh_of(bpy, OPERATOR, joined([make_part(each) for each in (head, body)]))
    mesh.materials.append(make_light_material(bpy, spec.radiance * 2.0**exposure))
    figure = bpy.data.objects.new(OPERATOR, mesh)
    figure.visible_camera = False
    return figure
