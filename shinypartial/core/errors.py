"""Errors caused by the user's input, and the single place that turns them into a message and an exit code."""

import errno
import sys
from collections.abc import Callable

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130


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


def run_command(command: Callable[[], None]) -> int:
    """Run a command; return 0, 2 for bad input (one message, no traceback) or 130 when interrupted."""
    try:
        command()
    except InputError as error:
        message = error
    except OSError as error:
        message = from_os_error(error)
    except KeyboardInterrupt:
        print("\nInterrupted. Run the same command again to continue where it stopped.", file=sys.stderr)
        return EXIT_INTERRUPTED
    else:
        return 0
    print(
        f"error: expected {message.expected}\n       found    {message.found}\n       remedy   {message.remedy}",
        file=sys.stderr,
    )
    return EXIT_BAD_INPUT
