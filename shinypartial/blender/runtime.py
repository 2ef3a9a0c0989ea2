"""Getting at Blender: a clear refusal where it can't run, a quiet terminal, the fastest device."""

import contextlib
import importlib
import importlib.util
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from shinypartial.core.errors import InputError
from shinypartial.io.system import flush_c_streams

#: Versions of Python that a release of bpy is built for, the one of the newest Blender last.
PYTHONS_OF_BPY = ("3.11", "3.13")
INSTALL = "pip install 'panoless[blender]'"
GPU_KINDS = ("OPTIX", "CUDA", "HIP", "METAL", "ONEAPI")


def check_blender() -> None:
    """Raise InputError unless this Python can import bpy; imports nothing."""
    version = "{}.{}".format(*sys.version_info[:2])
    if importlib.util.find_spec("bpy") is None:
        if version not in PYTHONS_OF_BPY:
            raise InputError(
                expected=f"Python {' or '.join(PYTHONS_OF_BPY)} to render with Blender as a module",
                found=f"Python {version}, for which there is no such module",
                remedy=f"Make an environment with Python {PYTHONS_OF_BPY[-1]} and run: {INSTALL}",
            )
        raise InputError(
            expected="Blender as a Python module (bpy) to render with",
            found="no module named bpy",
            remedy=f"Install it: {INSTALL}",
        )


def import_blender() -> Any:
    """The module bpy; raises InputError where it is missing or can't be loaded."""
    check_blender()
    try:
        with quiet():
            return importlib.import_module("bpy")
    except ImportError as error:
        raise InputError(
            expected="Blender as a Python module (bpy) that loads",
            found=str(error),
            remedy=f"Install what it names, or install bpy again: {INSTALL}",
        ) from None


@contextlib.contextmanager
def quiet() -> Iterator[BinaryIO]:
    """Send everything that is written to the terminal, by C code too, to a temporary file that is yielded."""
    sys.stdout.flush()
    sys.stderr.flush()
    with tempfile.TemporaryFile() as log:
        saved = {stream: os.dup(stream) for stream in (1, 2)}
        try:
            for stream in saved:
                os.dup2(log.fileno(), stream)
            yield log
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            flush_c_streams()
            for stream, copy in saved.items():
                os.dup2(copy, stream)
                os.close(copy)


@contextlib.contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Hold back Ctrl-C and raise KeyboardInterrupt at the end.

    Python code that Blender calls would raise it in the middle of a render, and Blender would swallow it.
    """
    previous = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(previous):
        yield
        return
    received: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _: received.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
    if received:
        raise KeyboardInterrupt


def choose_device(bpy: Any) -> str:
    """Enable every GPU of the first kind that Cycles finds and return that kind, or CPU."""
    bpy.context.scene.cycles.device = "CPU"
    preferences = bpy.context.preferences.addons["cycles"].preferences
    for kind in GPU_KINDS:
        try:
            preferences.compute_device_type = kind
        except TypeError:  # This build of Blender doesn't know the kind.
            continue
        preferences.get_devices()
        found = [device for device in preferences.devices if device.type == kind]
        for device in preferences.devices:
            device.use = device in found
        if found:
            bpy.context.scene.cycles.device = "GPU"
            return kind
    preferences.compute_device_type = "NONE"
    return "CPU"


def set_threads(bpy: Any, threads: int | None) -> None:
    """How many CPU threads render every scene; one for each core when None."""
    for scene in bpy.data.scenes:
        scene.render.threads_mode = "FIXED" if threads else "AUTO"
        if threads:
            scene.render.threads = threads


def studio_light(name: str) -> Path:
    """The file of one of Blender's environment maps, found without loading Blender."""
    check_blender()
    spec = importlib.util.find_spec("bpy")
    found = [
        path
        for folder in (spec.submodule_search_locations or [] if spec else [])
        for path in Path(folder).glob(f"[0-9]*/datafiles/studiolights/world/{name}.exr")
    ]
    if not found:
        raise InputError(
            expected=f"Blender's environment map {name} among the files of the module bpy",
            found="no such file",
            remedy=f"Install it again: {INSTALL}",
        )
    return found[0]
