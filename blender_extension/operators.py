# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panels offer: a light from photographs, a prediction, an inserted object, a benchmark of the scene."""

from math import degrees
from pathlib import Path

import bpy
from bpy.props import BoolProperty, CollectionProperty, EnumProperty, StringProperty
from bpy_extras.io_utils import ImportHelper

from .build import mirror_of, photograph_cameras, show_photograph
from .content import PREDICTION as PREDICTION_FILE
from .content import check_prediction
from .insert import nearest_photograph, over_photograph, stand_on_ground, step_aside
from .job import NEXT
from .light import PREFIX, update_light
from .program import Problem
from .running import BENCHMARK, LIGHT, PREDICTION, JobOperator, convert_step, work_folder

PICTURES = "*.jpg;*.jpeg;*.png;*.tif;*.tiff;*.exr;*.hdr;*.dng;*.cr2;*.cr3;*.nef;*.arw;*.mp4;*.mov;*.avi;*.mkv;*.json"
CAMERAS = "transforms_train.json"
#: panoless knows these photographs by name.
EXAMPLE = "lobby-ball"


class PANOLESS_OT_light(JobOperator, bpy.types.Operator, ImportHelper):
    """Light the scene by what a shiny object mirrors in photographs, in a video, or in a dataset"""

    bl_idname, bl_label = "panoless.light", "Light from Photographs"

    filter_glob: StringProperty(default=PICTURES, options={"HIDDEN"})
    directory: StringProperty(subtype="DIR_PATH", options={"HIDDEN", "SKIP_SAVE"})
    files: CollectionProperty(type=bpy.types.OperatorFileListElement, options={"HIDDEN", "SKIP_SAVE"})
    object: EnumProperty(
        name="Object",
        description="What the photographs show",
        items=[
            ("auto", "Automatic", "A ball where few photographs show one, else any object"),
            ("ball", "Mirror Ball", "From one photograph on, without masks and poses"),
            ("any", "Any Object", "At least eight photographs from different places"),
        ],
    )
    preset: EnumProperty(
        name="Fit",
        description="How thorough the fit is",
        items=[("default", "Default", ""), ("fast", "Fast", "Coarser, in about half of the time")],
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Capture, fit, convert; the world follows."""
        folder = Path(self.directory or self.filepath)
        chosen = [folder / each.name for each in self.files if each.name]
        sources = chosen or [Path(self.filepath)] if self.filepath or chosen else [folder]
        if len(sources) == 1 and sources[0].name == CAMERAS:
            sources = [sources[0].parent]
        if missing := [str(each) for each in sources if not each.exists()]:
            return self.refuse(f"There is nothing at {', '.join(missing)}. Choose photographs, a video or a dataset")
        if len(sources) == 1 and (sources[0] / CAMERAS).is_file():
            words = ["panoless", "fit", str(sources[0].resolve()), "--output", "prediction"]
            steps = [[*words, "--preset", self.preset, "--json-progress"]]
        else:
            steps = photograph_steps([str(each.resolve()) for each in sources], self.object, self.preset)
        return self.run(context, LIGHT, [*steps, convert_step("{prediction}")])


class PANOLESS_OT_example(JobOperator, bpy.types.Operator):
    """Light the scene by three photographs of a mirror ball in a lobby, which come with panoless"""

    bl_idname, bl_label = "panoless.example", "Try a Lobby"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """As of photographs of one's own."""
        return self.run(context, LIGHT, [*photograph_steps([EXAMPLE], "ball", "default"), convert_step("{prediction}")])


def photograph_steps(sources: list[str], kind: str, preset: str) -> list[list[str]]:
    """The commands from photographs to a prediction."""
    capture = ["panoless", "capture", *sources, "--output", "dataset", "--object", kind, "--json-progress"]
    return [capture, [NEXT, "--output", "prediction", "--preset", preset, "--json-progress"]]


class PANOLESS_OT_import(JobOperator, bpy.types.Operator, ImportHelper):
    """Import the folder of a fit or its prediction.json: mirror, cameras with photographs, ground, near walls, light"""

    bl_idname, bl_label = "panoless.import_prediction", "Import Prediction"

    filename_ext = ".json"
    filter_glob: StringProperty(default=PREDICTION_FILE, options={"HIDDEN"})
    filepath: StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Of a file that was dropped at once, else by the file browser."""
        return self.execute(context) if self.filepath else super().invoke(context, event)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Convert the folder and build the scene of it."""
        path = Path(self.filepath)
        folder = path if path.is_dir() else path.parent
        try:
            check_prediction(folder)
        except Problem as problem:
            return self.refuse(problem)
        return self.run(context, PREDICTION, [convert_step(str(folder.resolve()))])


class PANOLESS_OT_photograph(bpy.types.Operator):
    """Look through the camera of a photograph, with renders of its size"""

    bl_idname, bl_label = "panoless.photograph", "View Photograph"
    bl_options = {"REGISTER", "UNDO"}

    step: EnumProperty(
        name="Which",
        items=[
            ("NEAREST", "Nearest", "The photograph that shows most what the viewport shows"),
            ("NEXT", "Next", "The photograph after the present one"),
            ("PREVIOUS", "Previous", "The photograph before the present one"),
        ],
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Where photographs were imported."""
        if not photograph_cameras(context.scene):
            cls.poll_message_set("Import a prediction with cameras first")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Change the scene's camera and its resolution."""
        scene, cameras = context.scene, photograph_cameras(context.scene)
        camera = nearest_photograph(scene, viewport_of(context))
        if self.step != "NEAREST" and scene.camera in cameras:
            camera = cameras[(cameras.index(scene.camera) + (1 if self.step == "NEXT" else -1)) % len(cameras)]
        show_photograph(scene, camera)
        if context.region_data is not None:
            context.region_data.view_perspective = "CAMERA"
        return {"FINISHED"}


class PANOLESS_OT_insert(bpy.types.Operator):
    """Light the selected objects by the recovered light, beside the mirror, in the photograph nearest to the view"""

    bl_idname, bl_label = "panoless.insert", "Light It with This"
    bl_options = {"REGISTER", "UNDO"}

    on_ground: BoolProperty(name="On the Ground", description="Put them on what the mirror stands on", default=True)
    aside: BoolProperty(name="Beside the Mirror", description="Move them out of the mirror", default=True)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """With a light, and something to be lit."""
        if PREFIX not in bpy.data.worlds:
            cls.poll_message_set("Make a light from photographs, or import a prediction, first")
            return False
        if not cls._chosen(context):
            cls.poll_message_set("Select an object with a surface that is not the mirror")
            return False
        return True

    @staticmethod
    def _chosen(context: bpy.types.Context) -> list[bpy.types.Object]:
        chosen = getattr(context, "selected_objects", None) or context.view_layer.objects.selected
        surfaces = ("MESH", "CURVE", "SURFACE", "META", "FONT")
        return [each for each in chosen if each.type in surfaces and "panoless" not in each]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """World, place, view, composition."""
        scene = context.scene
        scene.world = bpy.data.worlds[PREFIX]
        update_light(scene)
        camera = nearest_photograph(scene, viewport_of(context))
        over = camera is not None and over_photograph(scene, camera)
        for each in self._chosen(context):
            if self.aside:
                step_aside(scene, each)
            if self.on_ground:
                stand_on_ground(scene, each)
        if context.region_data is not None and camera is not None:
            context.region_data.view_perspective = "CAMERA"
        if not over:
            self.report({"WARNING"}, "Lit; but there is no photograph to show it in")
        elif mirror_of(scene) is None:
            self.report({"WARNING"}, "Lit; but there is no mirror that could show it: its surface is a cloud of points")
        return {"FINISHED"}


class PANOLESS_OT_benchmark(JobOperator, bpy.types.Operator):
    """Render a dataset with truth of the active object of this file, fit it, and score the fit"""

    bl_idname, bl_label = "panoless.benchmark", "Make Benchmark"

    @classmethod
    def ready(cls, context: bpy.types.Context) -> bool:
        """With an active mesh."""
        if context.object is None or context.object.type != "MESH":
            cls.poll_message_set("Make a mesh active: it is what reflects")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Save a copy of the file, generate, perturb, fit, evaluate."""
        settings = context.scene.panoless
        try:
            folder = work_folder(BENCHMARK)
            folder.mkdir(parents=True, exist_ok=True)
            bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"), copy=True, check_existing=False)
        except (OSError, RuntimeError) as error:
            return self.refuse(f"A copy of this file can't be written beside it ({error})")
        half = degrees(settings.bench_arc) / 2
        generate = ["shinypartial", "generate", "--scene", "scene.blend", "--object", context.object.name]
        for name, *values in (
            ("output", "dataset"),
            ("azimuth-deg", -half, half),
            ("facing-azimuth-deg", degrees(settings.bench_facing)),
            ("train", settings.bench_views),
            ("test", settings.bench_tests),
            ("resolution", settings.bench_resolution),
            ("samples", settings.bench_samples),
            ("world", world_file(context.scene) or settings.bench_world),
        ):
            generate += [f"--{name}", *(f"{each:.4f}" if isinstance(each, float) else str(each) for each in values)]
        steps, dataset = [[*generate, "--json-progress"]], "dataset"
        if settings.bench_noise > 0:
            noise = f"{settings.bench_noise:.4f}"
            steps.append(["shinypartial", "perturb", dataset, "--output", "noisy", "--sensor.read-noise", noise])
            dataset = "noisy"
        steps.append(["panoless", "fit", dataset, "--output", "prediction", "--json-progress"])
        steps.append(["shinypartial", "evaluate", "{prediction}", "--json-progress"])
        return self.run(context, BENCHMARK, steps, folder)


def world_file(scene: bpy.types.Scene) -> str:
    """The EXR file of the scene's world; empty where it has none on disk."""
    tree = scene.world.node_tree if scene.world else None
    for node in tree.nodes if tree else ():
        image = node.image if node.type == "TEX_ENVIRONMENT" else None
        path = Path(bpy.path.abspath(image.filepath)) if image else Path()
        if path.suffix.lower() == ".exr" and path.is_file():
            return str(path.resolve())
    return ""


def viewport_of(context: bpy.types.Context):
    """The camera-to-world matrix of the 3D viewport; None where it looks through a camera, or there is none."""
    region = context.region_data
    if region is None or region.view_perspective == "CAMERA":
        return None
    return region.view_matrix.inverted()


class PANOLESS_FH_prediction(bpy.types.FileHandler):
    """Drop prediction.json into the viewport to import its folder. Blender matches suffixes, which folders lack."""

    bl_idname, bl_label = "PANOLESS_FH_prediction", "PanoLess Prediction"
    bl_import_operator = "panoless.import_prediction"
    bl_file_extensions = ".json"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        """Onto a 3D viewport."""
        return context.area is not None and context.area.type == "VIEW_3D"


CLASSES = (
    PANOLESS_OT_light,
    PANOLESS_OT_example,
    PANOLESS_OT_import,
    PANOLESS_OT_photograph,
    PANOLESS_OT_insert,
    PANOLESS_OT_benchmark,
    PANOLESS_FH_prediction,
)
