# SPDX-License-Identifier: GPL-3.0-or-later
"""Commands of `panoless` in other processes, one after the other, and what they report. Without Blender.

A folder holds all of a job: `run.json` says what is to be done, so that a later session continues it.
"""

import json
import os
import queue
import signal
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from .program import INSTALL, PROGRESS_VERSION, Problem, Program, hidden

RECORD, LOG = "run.json", "log.txt"
RUNNING, CANCELLED, FAILED, DONE = "running", "cancelled", "failed", "done"
#: At the head of a step: the command that the step before named as the next.
NEXT = "{next}"
#: How long a process may take to stop before it is ended.
STOP_LIMIT_S = 10.0


class Job:
    """Steps, each the words of a command; `{NAME}` in them is a path from the results of earlier steps."""

    def __init__(self, program: Program, folder: Path, kind: str, steps: list[list[str]]) -> None:
        self.program, self.folder, self.kind, self.steps = program, folder, kind, steps
        self.state, self.message, self.stage, self.share = RUNNING, "", "starting", 0.0
        self.seconds_left: float | None = None
        self.warnings: list[str] = []
        self.lines: list[str] = []
        self.paths: dict[str, str] = {}
        self.verdict: dict[str, str] | None = None
        self._next: list[str] = []
        self._number = 0
        self._last: dict[str, Any] = {}
        self._process: subprocess.Popen | None = None
        self._events: queue.Queue = queue.Queue()
        self._stopping_since: float | None = None

    @classmethod
    def recorded(cls, program: Program, folder: Path) -> "Job":
        """The job of an earlier session; Problem where the folder has none."""
        content = read_record(folder)
        if content is None:
            raise Problem(f"There is no run in {folder}. Start a new one")
        return cls(program, folder, content["kind"], content["steps"])

    def start(self) -> None:
        """Begin the first step; Problem where the folder can't be written."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            (self.folder / LOG).write_text("", encoding="utf-8")
        except OSError as error:
            raise Problem(f"{self.folder} can't be written ({error.strerror}). Save the .blend elsewhere") from None
        self._record()
        self._begin()

    def poll(self) -> bool:
        """Read what has happened; whether the job has ended."""
        while self._process is not None:
            try:
                event = self._events.get_nowait()
            except queue.Empty:
                self._end_late_process()
                return False
            if event is None:
                self._finish_step()
            else:
                self._take(event)
        return True

    def wait(self) -> None:
        """Until the job has ended."""
        try:
            while not self.poll():
                time.sleep(0.05)
        finally:
            self.kill()

    def cancel(self) -> None:
        """Ask the process to stop; what it has finished stays."""
        if self._process is None or self._stopping_since is not None:
            return
        self.stage, self._stopping_since = "stopping", time.monotonic()
        if os.name == "nt":
            self._process.terminate()
        else:
            self._process.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """End the process at once."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    @property
    def text(self) -> str:
        """The present state in a line."""
        left = self.seconds_left
        rest = "" if left is None else f", {left:.0f} s left" if left < 100 else f", {left / 60:.0f} min left"
        return f"{self.stage}{rest}"

    def _begin(self) -> None:
        first, *options = self.steps[self._number]
        words = [*self._next, *options] if first == NEXT else [first, *options]
        name, *rest = map(self._filled, words)
        self._last, self.share, self.seconds_left = {}, 0.0, None
        try:
            with (self.folder / LOG).open("a", encoding="utf-8") as log:
                self._process = subprocess.Popen(
                    [self.program.command(name), *rest],
                    cwd=self.folder,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    text=True,
                    encoding="utf-8",
                    errors="replace",
                    **hidden(),
                )
        except OSError as error:
            self._end(FAILED, f"{self.program.command(name)} can't be started ({error.strerror})")
            return
        threading.Thread(target=self._read, args=(self._process,), daemon=True).start()

    def _filled(self, word: str) -> str:
        for name, path in self.paths.items():
            word = word.replace(f"{{{name}}}", path)
        return word

    def _read(self, process: subprocess.Popen) -> None:
        """In a thread: lines to events, None at the end."""
        with process.stdout:
            for line in process.stdout:
                with suppress(ValueError):
                    event = json.loads(line)
                    if isinstance(event, dict):
                        self._events.put(event)
        process.wait()
        self._events.put(None)

    def _take(self, event: dict[str, Any]) -> None:
        kind = event.get("event")
        if kind == "start" and event.get("format_version") != PROGRESS_VERSION:
            known, found = PROGRESS_VERSION, event.get("format_version")
            self.message = (
                f"This extension reads version {known} of panoless's progress; panoless {event.get('version')} writes "
                f"version {found}. Update the extension"
            )
            self.kill()
        elif kind == "stage":
            self.stage, self.share, self.seconds_left = event["stage"], 0.0, None
        elif kind == "progress":
            self.stage, self.seconds_left = event["stage"], event["seconds_left"]
            self.share = event["done"] / max(event["total"], 1)
        elif kind == "warning":
            self.warnings.append(event["text"])
        elif kind == "result":
            self.paths |= event["paths"]
            self.lines += event["lines"]
            self.verdict, self._next = event["verdict"] or self.verdict, event["next"]
        if kind in ("result", "error", "cancelled"):
            self._last = event

    def _finish_step(self) -> None:
        """The process has ended."""
        assert self._process is not None
        code, self._process, last = self._process.returncode, None, self._last
        reports = "--json-progress" in self.steps[self._number]
        if self.message:
            self._end(FAILED, self.message)
        elif self._stopping_since is not None and last.get("event") != "result":
            self._end(CANCELLED, "Cancelled. Continue takes it up where it was")
        elif last.get("event") == "error":
            said = f"Expected {last['expected']}; found {last['found']}. {last['remedy']}"
            self._end(FAILED, said.rstrip("."))
        elif code or (reports and last.get("event") != "result"):
            self._end(FAILED, self._unexplained(code))
        elif self._number + 1 < len(self.steps):
            self._number += 1
            self._begin()
        else:
            self._end(DONE, "")

    def _unexplained(self, code: int) -> str:
        try:
            log = (self.folder / LOG).read_text(encoding="utf-8", errors="replace").split("\n")
        except OSError:
            log = []
        said = next((line.strip(" │╭╰─╮╯") for line in reversed(log) if line.strip(" │╭╰─╮╯")), "nothing")
        if code == 2:  # A command line that it does not know.
            return f"This panoless does not know what the extension asks for: {said}. Update it: {INSTALL}"
        return f"panoless stopped without a result (exit code {code}; it wrote: {said}). See {self.folder / LOG}"

    def _end(self, state: str, message: str) -> None:
        self.state, self.message = state, message
        self._record()

    def _record(self) -> None:
        content = {"kind": self.kind, "state": self.state, "message": self.message, "steps": self.steps}
        with suppress(OSError):  # A full disk is said by the process itself.
            (self.folder / RECORD).write_text(json.dumps(content, indent=1), encoding="utf-8")

    def _end_late_process(self) -> None:
        since = self._stopping_since
        if since is not None and self._process is not None and time.monotonic() - since > STOP_LIMIT_S:
            self._process.kill()


def read_record(folder: Path) -> dict[str, Any] | None:
    """What `run.json` of a folder says; None where there is none that can be read."""
    try:
        content = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        steps = [[str(word) for word in step] for step in content["steps"]]
        return {"kind": str(content["kind"]), "state": str(content["state"]), "steps": steps}
    except (OSError, ValueError, KeyError, TypeError):
        return None
