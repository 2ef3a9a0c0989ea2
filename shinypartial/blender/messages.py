"""What a rendering process and its parent say to each other: pickled one after another through its two pipes."""

import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from shinypartial.core.camera import Camera
from shinypartial.core.errors import InputError
from shinypartial.scene import SceneSpec


@dataclass(frozen=True)
class Start:
    """The first message to a worker; cameras follow, one at a time."""

    spec: SceneSpec
    folder: Path
    """Its own folder for temporary files, which it removes when its parent ends."""
    threads: int


@dataclass(frozen=True)
class BackdropOf:
    """In place of a camera: what it sees around the object is requested."""

    camera: Camera


@dataclass(frozen=True)
class Ready:
    """The worker's first answer: the scene is assembled, on this device."""

    device: str


@dataclass(frozen=True)
class Refused:
    """An InputError on its way to the parent."""

    expected: str
    found: str
    remedy: str

    def error(self) -> InputError:
        """The error to raise."""
        return InputError(expected=self.expected, found=self.found, remedy=self.remedy)


def send(stream: IO[bytes], message: Any) -> None:
    """Write a message; OSError when the other side is gone."""
    pickle.dump(message, stream, protocol=pickle.HIGHEST_PROTOCOL)
    stream.flush()


def receive(stream: IO[bytes]) -> Any:
    """Read a message; EOFError when the other side is gone, also in the middle of a message."""
    try:
        return pickle.load(stream)
    except (pickle.UnpicklingError, EOFError):
        raise EOFError from None
