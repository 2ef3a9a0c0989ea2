"""What Linux, macOS and Windows do differently: locks, memory, processors. No other module depends on which of them
runs."""

import contextlib
import ctypes
import hashlib
import os
import platform
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import IO

import psutil
from filelock import FileLock, Timeout

if sys.platform != "win32":
    import fcntl
    import resource


def lock_folder(folder: Path) -> Callable[[], None]:
    """Lock a folder against other processes and return what unlocks it; BlockingIOError where another has it.

    The system unlocks it however the process ends. The folder itself is locked, so that nothing is added to it; where
    no folder can be (Windows, NFS), a file among the temporary ones stands for it, which only this machine sees.
    """
    if sys.platform != "win32":
        handle = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return partial(os.close, handle)
        except OSError as error:
            os.close(handle)
            if isinstance(error, BlockingIOError):
                raise
    words = f"{psutil.Process().username()} {folder.resolve()}"
    name = f"shinypartial-{hashlib.sha256(words.encode()).hexdigest()[:16]}.lock"
    stand_in = FileLock(Path(tempfile.gettempdir()) / name, mode=0o600)
    try:
        stand_in.acquire(blocking=False)
    except Timeout:
        raise BlockingIOError(f"{folder} is locked") from None
    return stand_in.release


@contextlib.contextmanager
def locked_log(log: IO[bytes]) -> Iterator[None]:
    """Wait for the lock of a file that is open to write; programs that write into it share the lock, not on Windows."""
    if sys.platform != "win32":
        fcntl.flock(log, fcntl.LOCK_EX)
        yield
    else:
        with FileLock(f"{log.name}.lock"):
            yield


def peak_memory_bytes() -> int:
    """The largest resident size of this process so far."""
    if sys.platform == "win32":
        return psutil.Process().memory_info().peak_wset
    unit = 1 if sys.platform == "darwin" else 1024  # Linux counts kibibytes, macOS bytes.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def release_free_memory() -> None:
    """Give pages that hold nothing back to the system, as far as the C library can: glibc keeps what was freed in
    pieces of up to 32 MB.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


def flush_c_streams() -> None:
    """Write what C code has printed, which would else appear later."""
    if sys.platform != "win32":
        ctypes.CDLL(None).fflush(None)


def usable_cores() -> int:
    """Cores that this process may run on."""
    process = psutil.Process()
    return len(process.cpu_affinity()) if hasattr(process, "cpu_affinity") else os.cpu_count() or 1


def processor_name() -> str:
    """The model of the processor as the system states it."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
