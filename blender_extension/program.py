# SPDX-License-Identifier: GPL-3.0-or-later
"""The installed `panoless`: where it is, which version it is, and how to install it. Without Blender."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

INSTALL = 'uv tool install "panoless[capture]"'
LEAST_VERSION = (0, 2)
#: Of the lines of --json-progress, and of scene.json.
PROGRESS_VERSION, SCENE_VERSION = 1, 1
VERSION_LIMIT_S = 60
SUFFIX = ".exe" if os.name == "nt" else ""
BINARIES = "Scripts" if os.name == "nt" else "bin"


class Problem(Exception):
    """What a person has to know: one message, shown as Blender shows messages."""


@dataclass(frozen=True)
class Program:
    """An installation, which has the commands `panoless` and `shinypartial` side by side."""

    path: Path
    version: str
    """Empty where it doesn't say."""

    def command(self, name: str) -> str:
        """The path of one of its commands."""
        return str(self.path.with_name(name + self.path.suffix))


def places() -> Iterator[Path]:
    """Where installers put it, the most likely first."""
    if found := shutil.which("panoless"):
        yield Path(found)
    home, given = Path.home(), os.environ.get
    folders = [Path(found) / BINARIES for name in ("VIRTUAL_ENV", "CONDA_PREFIX") if (found := given(name))]
    folders += [Path(found) for name in ("UV_TOOL_BIN_DIR", "PIPX_BIN_DIR", "XDG_BIN_HOME") if (found := given(name))]
    data = Path(given("APPDATA") or home) if os.name == "nt" else home / ".local" / "share"
    folders += [home / ".local" / "bin", data / "uv" / "tools" / "panoless" / BINARIES]
    for parent in (data / "pipx", home / "pipx", home / ".local" / "pipx"):
        folders.append(parent / "venvs" / "panoless" / BINARIES)
    folders += [home / name / BINARIES for name in (".venv", "venv", "panoless/.venv", ".venvs/panoless")]
    yield from (folder / f"panoless{SUFFIX}" for folder in folders)


def find() -> Path | None:
    """The first place that has it."""
    return next((path for path in places() if path.is_file()), None)


def version_of(path: Path) -> str:
    """What `panoless --version` says; empty for one that does not know the question."""
    try:
        done = subprocess.run(
            [str(path), "--version"],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=VERSION_LIMIT_S,
            check=False,
            **hidden(),
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise Problem(f"{path} can't be started ({error}). Choose another one in the preferences of PanoLess") from None
    found = re.search(r"\d+\.\d+(\.\w+)*", done.stdout) if done.returncode == 0 else None
    return found.group() if found else ""


def program_at(stated: str) -> Program:
    """The program at the path of the preferences, or the one that is found; Problem where there is none."""
    path = Path(stated).expanduser() if stated else find()
    if path is None:
        raise Problem(
            f"panoless is not installed, or not where it is looked for. Install it ({INSTALL}), or choose it "
            "in the preferences of PanoLess"
        )
    if not path.is_file():
        raise Problem(f"There is no panoless at {path}. Choose it in the preferences of PanoLess")
    version = version_of(path)
    if version and tuple(map(int, version.split(".")[:2])) < LEAST_VERSION:
        least = ".".join(map(str, LEAST_VERSION))
        raise Problem(f"This extension needs panoless {least} or newer; {path} is {version}. Update it: {INSTALL}")
    return Program(path, version)


def hidden() -> dict:
    """Arguments by which a process gets no window of its own."""
    return {"creationflags": subprocess.CREATE_NO_WINDOW} if sys.platform == "win32" else {}
