"""A process that renders what its parent requests: `python -m shinypartial.blender.worker`, started by `worker_pool`.

Blender keeps memory that it no longer uses, must not be forked and may crash; in a process of its own it does no harm.
"""

import contextlib
import os
import queue
import shutil
import signal
import sys
import threading
from pathlib import Path
from typing import IO, Any

from shinypartial.blender.messages import BackdropOf, Ready, Refused, Start, receive, send
from shinypartial.blender.render import open_renderer
from shinypartial.core.errors import InputError, from_os_error


def main() -> None:
    """Serve cameras until the parent closes the pipe or dies."""
    # The terminal sends Ctrl-C to every process in front; the parent decides what becomes of this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    requests, replies = _take_pipes()
    try:
        start: Start = receive(requests)
    except EOFError:
        return
    cameras: queue.Queue[Any] = queue.Queue()
    threading.Thread(target=_listen, args=(requests, cameras, start.folder), daemon=True).start()
    try:
        with open_renderer(start.spec, threads=start.threads, folder=start.folder) as renderer:
            send(replies, Ready(renderer.device))
            while True:
                message = cameras.get()
                backdrop = isinstance(message, BackdropOf)
                send(replies, renderer.render_backdrop(message.camera) if backdrop else renderer.render(message))
    except (InputError, OSError) as error:
        refusal = from_os_error(error) if isinstance(error, OSError) else error
        send(replies, Refused(refusal.expected, refusal.found, refusal.remedy))


def _take_pipes() -> tuple[IO[bytes], IO[bytes]]:
    """Keep both pipes for messages; what Blender prints goes where errors go."""
    requests, replies = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    sys.stdout.flush()
    os.dup2(2, 1)
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    return requests, replies


def _listen(requests: IO[bytes], cameras: "queue.Queue[Any]", folder: Path) -> None:
    """Pass cameras on; when the pipe ends so does this process, also in the middle of a frame."""
    with contextlib.suppress(EOFError):
        while True:
            cameras.put(receive(requests))
    shutil.rmtree(folder, ignore_errors=True)
    with contextlib.suppress(OSError):  # The last of the workers removes what holds their folders.
        folder.parent.rmdir()
    os._exit(0)


if __name__ == "__main__":
    main()
