"""One progress line with an estimate of the time left; plain lines where there is no terminal, events for programs."""

import sys
import time
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from shinypartial.io.events import StepsDone, emit, reporting

PLAIN_LINE_INTERVAL_S = 10.0
TERMINAL_INTERVAL_S = 0.1
EVENT_INTERVAL_S = 0.5
BAR_WIDTH = 24


@runtime_checkable
class TextStream(Protocol):
    """What the line is written to: standard error, or anything that takes text in its place."""

    def write(self, text: str, /) -> object:
        """Write text."""

    def flush(self) -> object:
        """Show what was written."""

    def isatty(self) -> bool:
        """Whether it is a terminal, which can rewrite its last line."""
        ...


def format_seconds(seconds: float) -> str:
    """Seconds as `42 s` or `3 min 05 s`."""
    whole = round(seconds)
    return f"{whole} s" if whole < 60 else f"{whole // 60} min {whole % 60:02d} s"


@dataclass
class Progress:
    """Report `done` of `total` steps; work that an earlier run finished counts in `done`, not in the speed."""

    label: str
    total: int
    done: int = 0
    stream: TextStream = field(default_factory=lambda: sys.stderr)
    _start_s: float = field(default_factory=time.monotonic)
    _start_done: int = -1
    _last_s: float = 0.0

    def __post_init__(self) -> None:
        self._start_done = self.done

    def advance(self, note: str = "", steps: int = 1) -> None:
        """Count `steps` more and show the line when it is due."""
        self.done += steps
        now = time.monotonic()
        events, terminal = reporting(), self.stream.isatty()
        interval = EVENT_INTERVAL_S if events else TERMINAL_INTERVAL_S if terminal else PLAIN_LINE_INTERVAL_S
        last = self.done >= self.total
        if not last and now - self._last_s < interval:
            return
        self._last_s = now
        if events:
            emit(StepsDone(self.label, self.done, self.total, self.seconds_left(now), note))
            return
        line = self.line(now, note)
        if terminal:
            self.stream.write("\r\x1b[2K" + line + ("\n" if last else ""))
        else:
            self.stream.write(line + "\n")
        self.stream.flush()

    def seconds_left(self, now_s: float) -> float | None:
        """At monotonic time `now_s`, by the speed up to then; None before the first step."""
        steps = self.done - self._start_done
        return (now_s - self._start_s) / steps * max(self.total - self.done, 0) if steps else None

    def line(self, now_s: float, note: str = "") -> str:
        """The progress line at monotonic time `now_s`."""
        share = self.done / max(self.total, 1)
        left = self.seconds_left(now_s)
        if self.done >= self.total:
            time_text = f"took {format_seconds(now_s - self._start_s)}"
        else:
            time_text = "estimating" if left is None else f"{format_seconds(left)} left"
        bar = "█" * int(share * BAR_WIDTH) + "░" * (BAR_WIDTH - int(share * BAR_WIDTH))
        return f"{self.label} {bar} {self.done}/{self.total}  {time_text}{'  ' + note if note else ''}"
