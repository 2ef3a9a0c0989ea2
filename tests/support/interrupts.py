"""Interrupts that arrive wherever tests run."""

import signal


def heed_interrupts() -> None:
    """Raise KeyboardInterrupt at SIGINT; for `preexec_fn`, too.

    A shell without job control starts background processes with interrupts ignored, and so do their children.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
