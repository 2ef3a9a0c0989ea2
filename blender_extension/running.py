# SPDX-License-Identifier: GPL-3.0-or-later
"""A job while Blender goes on: a timer reads its progress, the status bar shows it, and what it made is taken in."""

import time
from pathlib import Path

import bpy

from .build import build
from .content import Content
from .job import CANCELLED, DONE, RUNNING, Job, read_record
from .program import Problem
from .settings import installed

TIMER_S = 0.25
CONVERTED = "blender"
LIGHT, PREDICTION, BENCHMARK = "light", "prediction", "benchmark"
#: The one job of this session, which may have ended.
current: Job | None = None


def active() -> Job | None:
    """The job that runs now."""
    return current if current is not None and current.state == RUNNING else None


def work_folder(kind: str) -> Path:
    """Where a job works: beside the .blend, or among the extension's own files until that is saved."""
    if bpy.data.filepath:
        blend = Path(bpy.data.filepath)
        return blend.with_name(f"{blend.stem}-panoless") / kind
    own = Path(bpy.utils.extension_path_user(__package__, path="runs", create=True))
    return own / f"{time.strftime('%Y-%m-%d-%H%M%S')}-{kind}"


def begun_folder(scene: bpy.types.Scene) -> Path | None:
    """The folder of a job that an earlier session left unfinished; None where there is none."""
    folders = [Path(bpy.path.abspath(scene.panoless.run_folder))] if scene.panoless.run_folder else []
    if bpy.data.filepath:
        folders += [work_folder(kind) for kind in (LIGHT, BENCHMARK, PREDICTION)]
    begun = (folder for folder in folders if (record := read_record(folder)) and record["state"] != DONE)
    return next(begun, None)


def convert_step(prediction: str) -> list[str]:
    """The command that prepares a prediction for Blender."""
    return ["shinypartial", "convert", prediction, "--to", "extension", "--output", CONVERTED, "--json-progress"]


class JobOperator:
    """An operator that runs a job: modal in a window, to its end in background."""

    bl_options = {"REGISTER"}
    _timer = None

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """One job at a time."""
        if active() is not None:
            cls.poll_message_set("PanoLess is at work; cancel that first")
            return False
        return cls.ready(context)

    @classmethod
    def ready(cls, _context: bpy.types.Context) -> bool:
        """Whether the operator has what it needs."""
        return True

    def run(self, context: bpy.types.Context, kind: str, steps: list[list[str]], folder: Path | None = None) -> set:
        """Start the steps."""
        try:
            job = Job(installed(context), folder or work_folder(kind), kind, steps)
            return self.go(context, job)
        except Problem as problem:
            return self.refuse(problem)
        except OSError as error:
            return self.refuse(f"{error.filename} can't be written ({error.strerror})")

    def go(self, context: bpy.types.Context, job: Job) -> set:
        """Start a job."""
        global current
        job.start()
        current, self._scene = job, context.scene.name
        context.scene.panoless.run_folder = str(job.folder)
        if bpy.app.background or context.window is None:
            job.wait()
            return self.finish(context)
        manager = context.window_manager
        self._timer = manager.event_timer_add(TIMER_S, window=context.window)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set:
        """Read what has happened since the last time."""
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if current is None:
            self._remove_timer(context)
            return {"CANCELLED"}
        ended = current.poll()
        if context.workspace is not None:
            context.workspace.status_text_set(None)  # Redraws the status bar.
        for window in context.window_manager.windows:
            for area in window.screen.areas:
                if area.type == "VIEW_3D":
                    area.tag_redraw()
        if not ended:
            return {"PASS_THROUGH"}
        self._remove_timer(context)
        return self.finish(context)

    def cancel(self, context: bpy.types.Context) -> None:
        """Another file is opened, or Blender ends: the job stops, and its folder continues it later."""
        self._remove_timer(context)
        stop()

    def finish(self, context: bpy.types.Context) -> set:
        """Take in what an ended job made, or say why it made nothing."""
        assert current is not None
        job, scene = current, bpy.data.scenes.get(self._scene)
        if scene is None:
            return self.refuse("The scene that this was for is gone. Its files are in " + str(job.folder))
        if job.state == CANCELLED:
            self.report({"WARNING"}, job.message)
            return {"CANCELLED"}
        if job.state != DONE:
            return self.refuse(job.message)
        try:
            missing = take_in(scene, job)
        except Problem as problem:
            return self.refuse(problem)
        for warning in [*job.warnings, *missing]:
            self.report({"WARNING"}, warning)
        self.report({"INFO"}, scene.panoless.score if job.kind == BENCHMARK else scene.panoless.verdict or "Done")
        if not bpy.app.background:
            bpy.ops.ed.undo_push(message=self.bl_label)
        return {"FINISHED"}

    def refuse(self, problem: object) -> set:
        """One message, as Blender shows them."""
        self.report({"ERROR"}, str(problem))
        return {"CANCELLED"}

    def _remove_timer(self, context: bpy.types.Context) -> None:
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None


def take_in(scene: bpy.types.Scene, job: Job) -> list[str]:
    """Put what a job made into the scene; what is missing, a sentence each."""
    if job.kind == BENCHMARK:
        scene.panoless.score = "\n".join(job.lines)
        return []
    return build(scene, Content(job.folder / CONVERTED))


def stop() -> None:
    """End the job of this session at once; its folder continues it."""
    global current
    if active() is not None:
        current.kill()
    current = None


class PANOLESS_OT_cancel(bpy.types.Operator):
    """Stop the run; Continue takes it up where it was"""

    bl_idname, bl_label = "panoless.cancel", "Cancel"

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """While a job runs."""
        if active() is None:
            cls.poll_message_set("PanoLess is not at work")
            return False
        return True

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Ask it to stop."""
        current.cancel()
        return {"FINISHED"}


class PANOLESS_OT_continue(JobOperator, bpy.types.Operator):
    """Take up the run of this file that was cancelled, failed or interrupted"""

    bl_idname, bl_label = "panoless.continue_run", "Continue"

    @classmethod
    def ready(cls, context: bpy.types.Context) -> bool:
        """Where one was left."""
        if begun_folder(context.scene) is None:
            cls.poll_message_set("This file has no unfinished run")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start its commands again: they know what they have finished."""
        try:
            return self.go(context, Job.recorded(installed(context), begun_folder(context.scene)))
        except Problem as problem:
            return self.refuse(problem)


CLASSES = (PANOLESS_OT_cancel, PANOLESS_OT_continue)
