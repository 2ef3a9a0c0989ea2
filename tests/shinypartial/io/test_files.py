"""Files appear whole or not at all."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from shinypartial.core.errors import InputError
from shinypartial.io.files import (
    atomic_write,
    copy_or_link,
    folder_lock,
    link_or_copy,
    newest_folder,
    read_json,
    read_table,
    sha256_of,
    write_between,
    write_json,
    write_text,
)


def test_a_finished_file_replaces_the_old_one_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    write_text(path, "old")
    write_text(path, "größer")
    assert path.read_text(encoding="utf-8") == "größer"
    assert list(path.parent.iterdir()) == [path]
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize("can_link", [True, False])
def test_a_file_is_linked_or_else_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, can_link: bool) -> None:
    def refuse(old: Path, new: Path) -> None:
        raise OSError(errno.EPERM, "no links here")

    if not can_link:
        monkeypatch.setattr(os, "link", refuse)
        with pytest.raises(InputError, match="Leave out --link"):
            copy_or_link(tmp_path / "old", tmp_path / "new", link=True)
    (tmp_path / "old").write_bytes(b"same")
    link_or_copy(tmp_path / "old", tmp_path / "new")
    assert (tmp_path / "new").read_bytes() == b"same"
    assert (tmp_path / "new").samefile(tmp_path / "old") == can_link


@pytest.mark.parametrize("failure", [RuntimeError("stop"), KeyboardInterrupt()])
def test_a_failure_keeps_the_old_file_and_leaves_nothing_else(tmp_path: Path, failure: BaseException) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def write_half() -> None:
        with atomic_write(path) as temporary:
            temporary.write_bytes(b"half of the new")
            raise failure

    with pytest.raises(type(failure)):
        write_half()
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_killed_process_leaves_only_a_partial_file(tmp_path: Path) -> None:
    path = tmp_path / "r_000.exr"
    program = (
        "import sys, time, pathlib; from shinypartial.io.files import atomic_write\n"
        f"with atomic_write(pathlib.Path({str(path)!r})) as temporary:\n"
        "    temporary.write_bytes(b'half'); print('written', flush=True); time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"written\n"
        process.send_signal(signal.SIGKILL)
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".partial-")
    assert left.suffix == ".exr", "Image writers choose their format by the suffix."


HOLD = """
import pathlib, sys, time
from shinypartial.io.files import folder_lock
{before}
with folder_lock(pathlib.Path({folder!r})):
    print('held', flush=True)
    time.sleep(60)
"""
#: A file system that locks files but no folders, as NFS does.
NO_FOLDER_LOCKS = """
import fcntl, os, stat
flock = fcntl.flock
def refuse_folders(handle, operation):
    if stat.S_ISDIR(os.fstat(handle).st_mode):
        raise OSError(9, "Bad file descriptor")
    flock(handle, operation)
fcntl.flock = refuse_folders
"""


def hold(folder: Path, before: str = "") -> "subprocess.Popen[str]":
    """A process of its own that holds the folder."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD.format(folder=str(folder), before=before)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def take(folder: Path) -> None:
    with folder_lock(folder):
        assert folder.is_dir()


@pytest.mark.parametrize("file_system", ["any", "without folder locks"])
def test_one_process_holds_a_folder_until_it_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file_system: str
) -> None:
    fcntl = pytest.importorskip("fcntl")
    places = tmp_path / "places"
    places.mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    before = ""
    if file_system != "any":
        before = NO_FOLDER_LOCKS
        monkeypatch.setattr(fcntl, "flock", fcntl.flock)  # Restored afterwards.
        exec(before, {})
    folder = places / "new" / "dataset"
    with hold(folder, before) as process:
        with pytest.raises(InputError, match="another run that is writing there") as caught:
            take(folder)
        assert "Wait until it ends" in caught.value.remedy
        take(places / "new" / "other")
        process.send_signal(signal.SIGKILL)
    take(folder)
    take(folder)
    assert list(folder.iterdir()) == [], "Nothing is left that a release or a list of checksums would hold."


def test_a_failed_run_gives_its_folder_back(tmp_path: Path) -> None:
    def fail() -> None:
        with folder_lock(tmp_path):
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError):
        fail()
    take(tmp_path)


def test_a_child_that_outlives_its_run_does_not_hold_the_folder(tmp_path: Path) -> None:
    """Rendering processes don't inherit the lock."""
    with folder_lock(tmp_path):
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        take(tmp_path)
    finally:
        child.kill()
        child.wait()


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="a file"):
        take(tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"


def test_lines_are_replaced_between_marks_alone(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    assert not write_between(page, "a", ["new"])
    page.write_text("head\n<!-- a:begin -->\nold\n<!-- a:end -->\n<!-- b:begin -->\ntail\n")
    assert not write_between(page, "b", ["new"])
    for _ in range(2):
        assert write_between(page, "a", ["new"])
    marked = "<!-- a:begin -->\n\nnew\n\n<!-- a:end -->"
    assert page.read_text() == f"head\n{marked}\n<!-- b:begin -->\ntail\n"


def test_json_round_trip_is_exact(tmp_path: Path) -> None:
    content = {"a": [1, 0.1, -1e300, None, True], "ü": {"nested": "✓"}}
    write_json(tmp_path / "a.json", content)
    assert read_json(tmp_path / "a.json", "a file") == content


def test_json_never_holds_nan(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", [float("nan")])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("content", [b"{", b"\xff\xfe\x00", b"", b"[" * 200_000, b'{"a":' * 200_000, b"1" * 5000])
def test_broken_json_is_an_input_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "transforms_train.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"the cameras in .*transforms_train\.json to be JSON"):
        read_json(path, "the cameras")


@pytest.mark.parametrize("content", [[], None, 3, "text"])
def test_a_table_is_no_other_json(tmp_path: Path, content: object) -> None:
    write_json(tmp_path / "a.json", {"a": content})
    assert read_table(tmp_path / "a.json", "a file") == {"a": content}
    write_json(tmp_path / "a.json", content)
    with pytest.raises(InputError, match=r"a file in .*a\.json to be a table"):
        read_table(tmp_path / "a.json", "a file")


def test_missing_json_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_json(tmp_path / "a.json", "the cameras")


def test_checksum_of_a_known_text(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")  # FIPS 180-2, appendix B.1.
    assert sha256_of(tmp_path / "a") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_newest_folder_goes_by_the_marker_and_not_by_the_name(tmp_path: Path) -> None:
    for name, age_s in (("z-old", 100), ("a-new", 0)):
        (tmp_path / name).mkdir()
        marker = tmp_path / name / "done.json"
        marker.write_text(json.dumps({}))
        os.utime(marker, (time.time() - age_s,) * 2)
    (tmp_path / "unfinished").mkdir()
    assert newest_folder(tmp_path, "done.json", "a run", "Run it.").name == "a-new"


def test_no_folder_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Run it") as caught:
        newest_folder(tmp_path / "missing", "done.json", "a run", "Run it.")
    assert "done.json" in caught.value.found
