"""Errors caused by the user's input, and the single place that turns them into a message and an exit code."""

import errno
import os
import sys
from collections.abc import Callable
from typing import Protocol

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130


#: What torch says when it has no memory left, by an error that it shares with all else.
TORCH_OUT_OF_MEMORY = "out of memory", "allocate memory"


class InputError(Exception):
    """Something the user gave can't be used: says what was expected, what was found and what to do."""

    def __init__(self, *, expected: str, found: str, remedy: str) -> None:
        self.expected, self.found, self.remedy = expected, found, remedy
        super().__init__(f"expected {expected}; found {found}. {remedy}")


def from_os_error(error: OSError) -> InputError:
    """Translate a failed file operation into a message with a remedy."""
    place = error.filename or "the output folder"
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return InputError(
            expected=f"enough free space to write {place}",
            found=error.strerror or "a full disk",
            remedy="Free some space or choose another --output, then run the same command again: it continues.",
        )
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EEXIST, errno.EISDIR):
        return InputError(
            expected=f"to be able to read and write {place}",
            found=error.strerror or "no permission",
            remedy="Check its permissions, or choose another --output.",
        )
    return InputError(
        expected=f"a usable file at {place}", found=error.strerror or str(error), remedy="Check the path."
    )


def from_memory_error() -> InputError:
    """What to do where memory does not suffice."""
    return InputError(
        expected="enough memory for this command",
        found="none left",
        remedy="Close other programs, use smaller pictures or fewer of them, or take a machine with more memory.",
    )


def as_input_error(error: Exception) -> InputError | None:
    """What a person can do about an error; None of one that only its programmer can mend."""
    match error:
        case InputError():
            return error
        case OSError():
            return from_os_error(error)
        case MemoryError():
            return from_memory_error()
        case RuntimeError() if any(words in str(error) for words in TORCH_OUT_OF_MEMORY):
            return from_memory_error()
    return None


def run_command(command: Callable[[], None]) -> int:
    """Run a command; return 0, 2 for bad input (one message, no traceback) or 130 when interrupted.

    Notes of an interruption say what is lost.
    """
    try:
        command()
    except BrokenPipeError:
        raise
    except KeyboardInterrupt as stop:
        again = "Run the same command again: it continues after what it has finished."
        print("\nInterrupted.", again, *getattr(stop, "__notes__", ()), file=sys.stderr)
        return EXIT_INTERRUPTED
    except Exception as error:
        message = as_input_error(error)
        if message is None:
            raise
    else:
        return 0
    print(
        f"error: expected {message.expected}\n       found    {message.found}\n       remedy   {message.remedy}",
        file=sys.stderr,
    )
    return EXIT_BAD_INPUT


class Command(Protocol):
    """What a command line was parsed to."""

    def run(self) -> None:
        """Do it."""
        ...


def parse_and_run(parse: Callable[[], Command]) -> int:
    """Parse a command line and run the command; return 0, 2 for bad usage or bad input, 130 when interrupted.

    It ends without an error when the reader of standard output, such as `head`, has seen enough.
    """
    try:
        try:
            command = parse()
        except SystemExit as stop:
            code = EXIT_BAD_INPUT if stop.code else 0
        else:
            code = run_command(command.run)
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    return code
