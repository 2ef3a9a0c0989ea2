"""A release holds its datasets byte for byte, is the same when made again, and names every damaged byte."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shinypartial.cli import main
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import CHECKSUMS
from shinypartial.dataset.validate import validate
from shinypartial.io.files import folder_lock, sha256_of
from shinypartial.release import release as release_module
from shinypartial.release.archive import write_archive
from shinypartial.release.checksums import list_files
from shinypartial.release.publication import Publication
from shinypartial.release.release import release, validate_release
from tests.support.synthetic_dataset import make_sphere_dataset

PUBLICATION = Publication("mirror-balls", "1.0.0", "2026-01-31", 'Quote " & Sons', "https://example.org/balls")
OTHER_TIME_S = 1e9


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """Two tiny datasets; the second also holds a picture of its own, as a generator may add."""
    parent = tmp_path_factory.mktemp("datasets")
    roots = tuple(make_sphere_dataset(parent / name, 12, 2, 1, 8).root for name in ("ball", "sphere"))
    shutil.copy(roots[1] / "train/r_000.png", roots[1] / "contact_sheet.png")
    with (roots[1] / CHECKSUMS).open("a") as stream:
        stream.write(f"{sha256_of(roots[1] / 'contact_sheet.png')}  contact_sheet.png\n")
    return roots


@pytest.fixture(scope="module")
def released(datasets: tuple[Path, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Their release; tests restore what they change."""
    return release(datasets, tmp_path_factory.mktemp("releases") / "balls", PUBLICATION).root


@pytest.fixture(scope="module")
def unpacked(released: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first dataset out of its archive."""
    parent = tmp_path_factory.mktemp("unpacked")
    with tarfile.open(released / "archives/ball.tar") as archive:
        archive.extractall(parent, filter="data")
    return parent / "ball"


def contents(root: Path) -> dict[str, str]:
    """Every file below a folder with its checksum."""
    return {path.relative_to(root).as_posix(): sha256_of(path) for path in root.rglob("*") if path.is_file()}


def test_data_is_the_datasets_byte_for_byte(datasets: tuple[Path, ...], released: Path) -> None:
    for root in datasets:
        assert contents(released / "data" / root.name) == contents(root)


def test_an_unpacked_archive_keeps_every_promise(datasets: tuple[Path, ...], unpacked: Path) -> None:
    assert contents(unpacked) == contents(datasets[0])
    assert [each for each in validate(unpacked) if not each.warning] == []


@pytest.mark.parametrize("suffix", [".tar", ".tar.gz"])
def test_a_copy_with_other_times_makes_the_same_release(
    datasets: tuple[Path, ...], tmp_path: Path, suffix: str
) -> None:
    copies = [Path(shutil.copytree(root, tmp_path / "copies" / root.name)) for root in datasets]
    for i, path in enumerate(sorted((tmp_path / "copies").rglob("*"))):
        os.utime(path, (OTHER_TIME_S + i, OTHER_TIME_S + i))
        path.chmod(0o700)
    first = release(datasets, tmp_path / "a" / "balls", PUBLICATION, suffix).root
    second = release(copies, tmp_path / "b" / "balls", PUBLICATION, suffix).root
    assert contents(first) == contents(second)


def test_archive_entries_say_nothing_about_who_made_them(released: Path) -> None:
    with tarfile.open(released / "archives/sphere.tar") as archive:
        entries = archive.getmembers()
    assert [entry.name for entry in entries] == sorted(entry.name for entry in entries)
    assert {(e.uid, e.gid, e.uname, e.gname, e.mode, e.isreg()) for e in entries} == {(0, 0, "", "", 0o644, True)}
    assert len({entry.mtime for entry in entries}) == 1


@pytest.mark.skipif(shutil.which("sha256sum") is None, reason="needs sha256sum")
def test_sha256sum_accepts_the_list_and_covers_everything(released: Path) -> None:
    command = ["sha256sum", "--check", "--strict", CHECKSUMS]
    result = subprocess.run(command, cwd=released, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert {line.removesuffix(": OK") for line in result.stdout.splitlines()} == set(list_files(released))


def damaged(violations: list, warnings: bool = False) -> set[str]:
    """The files that breaks name."""
    return {each.file for each in violations if warnings or not each.warning}


@contextmanager
def flipped_byte(root: Path, data: st.DataObject) -> Iterator[str]:
    """Damage one drawn byte of one drawn file, name the file, and restore it afterward."""
    name = data.draw(st.sampled_from([CHECKSUMS, *list_files(root)]))
    path = root / name
    original = path.read_bytes()
    place = data.draw(st.integers(0, len(original) - 1))
    mask = data.draw(st.integers(1, 255))
    path.write_bytes(original[:place] + bytes([original[place] ^ mask]) + original[place + 1 :])
    try:
        yield name
    finally:
        path.write_bytes(original)


@given(st.data())
def test_each_flipped_byte_of_a_release_is_found_and_named(released: Path, data: st.DataObject) -> None:
    with flipped_byte(released, data) as name:
        assert damaged(validate_release(released)) == {name}


@given(st.data())
def test_each_flipped_byte_of_an_unpacked_dataset_is_found_and_named(unpacked: Path, data: st.DataObject) -> None:
    """A dataset has no second list to judge its checksums by, so damage there is named beside the file it speaks of."""
    with flipped_byte(unpacked, data) as name:
        violations = [each for each in validate(unpacked) if not each.warning]
        assert any(name == each.file or name in each.problem for each in violations)


@pytest.mark.parametrize("separator", ["\x0b", "\x0c", "\r", "\x1c", "\x85"])
def test_a_line_feed_that_became_another_separator_is_found(unpacked: Path, separator: str) -> None:
    listing = unpacked / CHECKSUMS
    original = listing.read_bytes()
    listing.write_bytes(original[:-1] + separator.encode("latin-1"))
    try:
        assert any(CHECKSUMS in each.problem for each in validate(unpacked))
    finally:
        listing.write_bytes(original)


@pytest.fixture
def copy(released: Path, tmp_path: Path) -> Path:
    """A copy of the release to change."""
    return Path(shutil.copytree(released, tmp_path / "balls"))


@pytest.mark.parametrize("name", ["README.md", CHECKSUMS, "data/ball/train/r_000.exr", "archives/ball.tar"])
def test_a_missing_file_is_named(copy: Path, name: str) -> None:
    (copy / name).unlink()
    assert damaged(validate_release(copy)) == {name}


def test_extra_files_are_named_and_those_of_hosts_only_as_warnings(copy: Path) -> None:
    for name in ("data/ball/train/r_999.exr", ".gitattributes", ".partial-x"):
        (copy / name).write_text("x")
    violations = validate_release(copy)
    assert damaged(violations) == {"data/ball/train/r_999.exr", ".partial-x"}
    assert ".gitattributes" in damaged(violations, warnings=True)


def test_a_whole_release_validates_from_the_command_line(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", str(copy)]) == 0
    (copy / "README.md").write_text("x")
    assert main(["validate", str(copy)]) == 2
    assert "README.md" in capsys.readouterr().out


def test_a_killed_release_is_finished_by_the_same_command(
    datasets: tuple[Path, ...], released: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output, copied = tmp_path / "balls", release_module._copy

    def killed(source: Path, target: Path, sha256: str) -> bool:
        if source.name == "transforms_test.json" and source.parent.name == "sphere":
            (target.parent / ".partial-rest").write_text("half")
            raise KeyboardInterrupt
        return copied(source, target, sha256)

    with monkeypatch.context() as patch:
        patch.setattr(release_module, "_copy", killed)
        with pytest.raises(KeyboardInterrupt):
            release(datasets, output, PUBLICATION)
    assert not (output / CHECKSUMS).exists()
    damaged_file = output / "data/ball/dataset.json"
    damaged_file.write_text("{}")
    made = release(datasets, output, PUBLICATION)
    assert contents(output) == contents(released)
    assert made.kept > 0
    assert made.written > 0


def test_a_finished_release_is_kept(datasets: tuple[Path, ...], copy: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in (copy / "archives").iterdir()}
    assert release(datasets, copy, PUBLICATION).written == 0
    assert {path: path.stat().st_mtime_ns for path in (copy / "archives").iterdir()} == before
    (copy / "archives/ball.tar").write_bytes(b"damaged")
    assert release(datasets, copy, PUBLICATION).written == 1
    assert damaged(validate_release(copy)) == set()


@pytest.mark.parametrize("suffix", [".tar", ".tar.gz"])
def test_an_archive_depends_on_names_and_contents_only(unpacked: Path, tmp_path: Path, suffix: str) -> None:
    path, names = tmp_path / f"ball{suffix}", ["dataset.json", "train/r_000.png"]
    write_archive(path, unpacked, names)
    copy = Path(shutil.copytree(unpacked, tmp_path / "ball"))
    for name in names:
        os.utime(copy / name, (OTHER_TIME_S, OTHER_TIME_S))
        (copy / name).chmod(0o600)
    assert not write_archive(path, copy, names[::-1])
    assert write_archive(path, copy, names[:1])


def test_an_archive_with_a_long_name_can_be_read(tmp_path: Path) -> None:
    folder, name = tmp_path / "a", f"{'d' * 120}/{'ü' * 60}.txt"
    (folder / name).parent.mkdir(parents=True)
    (folder / name).write_text("x")
    write_archive(tmp_path / "a.tar", folder, [name])
    with tarfile.open(tmp_path / "a.tar") as archive:
        assert archive.getnames() == [f"a/{name}"]


def test_a_folder_of_something_else_is_refused(datasets: tuple[Path, ...], copy: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "README.md").write_text("mine")
    with pytest.raises(InputError, match="not a release"):
        release(datasets, other, PUBLICATION)
    with pytest.raises(InputError, match="another version"):
        release(datasets, copy, replace(PUBLICATION, version="2.0.0"))
    with pytest.raises(InputError, match="another datasets"):
        release(datasets[:1], copy, PUBLICATION)
    (copy / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"notes\.txt"):
        release(datasets, copy, PUBLICATION)
    assert (other / "README.md").read_text() == "mine"


def test_only_one_run_writes_to_a_release(datasets: tuple[Path, ...], tmp_path: Path) -> None:
    output = tmp_path / "balls"
    with folder_lock(output):
        (output / ".partial-other").write_text("half")
        with pytest.raises(InputError, match="another run"):
            release(datasets, output, PUBLICATION)
        assert [path.name for path in output.iterdir()] == [".partial-other"]


@pytest.mark.parametrize("content", ["[]", "null", '{"date": 3}'])
def test_a_damaged_claim_is_told(
    datasets: tuple[Path, ...], tmp_path: Path, content: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "release.json").write_text(content)
    assert main(["release", str(datasets[0]), "--output", str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["release.json"]


def test_bad_datasets_and_places_are_refused(damaged_dataset: Path, datasets: tuple[Path, ...], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="lies in it"):
        release(datasets, datasets[0] / "release", PUBLICATION)
    with pytest.raises(InputError, match="name of its own"):
        release([datasets[0], datasets[0]], tmp_path / "r", PUBLICATION)
    (damaged_dataset / "train/r_001.exr").write_bytes(b"")
    with pytest.raises(InputError, match=r"train/r_001\.exr"):
        release([damaged_dataset], tmp_path / "r", PUBLICATION)
    manifest = json.loads((damaged_dataset / "dataset.json").read_text())
    (damaged_dataset / "dataset.json").write_text(json.dumps({**manifest, "complete": False}))
    with pytest.raises(InputError, match="not complete"):
        release([damaged_dataset], tmp_path / "r", PUBLICATION)
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize(
    "change", [{"version": "one"}, {"date": "today"}, {"name": "a/b"}, {"creator": " "}, {"url": "ftp://x"}]
)
def test_facts_of_a_publication_are_checked(change: dict[str, str]) -> None:
    with pytest.raises(InputError, match=next(iter(change.values()))):
        replace(PUBLICATION, **change)


def test_the_card_says_what_a_reader_needs(released: Path) -> None:
    card = (released / "README.md").read_text()
    front = card.split("---\n")[1]
    assert 'license: ["cc0-1.0"]' in front
    assert "**ball**: name tests.support.synthetic_dataset" in card
    for word in ("## How it was rendered", "| resolution | 12 |", "## Splits", "+Z up", "## Licenses"):
        assert word in card
    for word in ("CC0-1.0", "NeRF-synthetic", "open_dataset", "## Citation", "sha256sum --check", "contact_sheet.png"):
        assert word in card


def test_the_front_matter_is_yaml(released: Path) -> None:
    yaml = pytest.importorskip("yaml")
    front = yaml.safe_load((released / "README.md").read_text().split("---\n")[1])
    assert front["license"] == ["cc0-1.0"]
    assert front["pretty_name"] == PUBLICATION.name


def test_there_is_a_license_row_for_each_asset(datasets: tuple[Path, ...], released: Path) -> None:
    rows = json.loads((released / "LICENSES.json").read_text())
    assert [(row["dataset"], row["asset"], row["license"]) for row in rows] == [
        (root.name, "*", "CC0-1.0") for root in datasets
    ]


@pytest.mark.skipif(importlib.util.find_spec("mlcroissant") is None, reason="needs mlcroissant")
def test_mlcroissant_accepts_the_metadata_and_loads_the_pictures(released: Path, tmp_path: Path) -> None:
    """In a process of its own: its dependencies warn on import, and it unpacks into the home folder."""
    program = (
        "import mlcroissant\n"
        "dataset = mlcroissant.Dataset('croissant.json')\n"
        "issues = dataset.metadata.ctx.issues\n"
        "assert not issues.errors and not issues.warnings, issues.report()\n"
        "assert dataset.metadata.ctx.conforms_to.value.endswith('/1.1')\n"
        "records = list(dataset.records('views'))\n"
        "print(len(records), {record['views/image'].size for record in records})\n"
    )
    command = [sys.executable, "-c", program]
    environment = {**os.environ, "HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
    result = subprocess.run(command, cwd=released, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    pictures = sum(name.endswith(".png") for name in list_files(released / "data"))
    assert result.stdout.strip() == f"{pictures} {{(12, 12)}}"


def test_the_command_keeps_the_date_of_a_release_that_was_begun(datasets: tuple[Path, ...], tmp_path: Path) -> None:
    output = tmp_path / "balls"
    arguments = ["release", *map(str, datasets), "--output", str(output)]
    assert main([*arguments, "--date", "2020-02-02"]) == 0
    before = contents(output)
    (output / CHECKSUMS).unlink()
    assert main(arguments) == 0
    assert contents(output) == before
