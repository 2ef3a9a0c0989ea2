"""Every example of the gallery runs as it is shown, and makes its picture."""

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = runpy.run_path(str(ROOT / "docs" / "examples" / "make_gallery.py"))


def test_the_gallery_has_a_page_in_the_navigation_and_a_picture_for_each_example() -> None:
    navigation = (ROOT / "docs" / "mkdocs.yml").read_text(encoding="utf-8")
    names = {path.stem for path in PROGRAM["EXAMPLES"]}
    assert {name for name in names if f"gallery/{name}.md" in navigation} == names
    assert {path.stem for path in (ROOT / "docs" / "images" / "gallery").iterdir()} == names


@pytest.mark.slow
@pytest.mark.parametrize("path", PROGRAM["EXAMPLES"], ids=lambda path: path.stem)
def test_an_example_runs_and_makes_its_picture(path: Path, tmp_path: Path) -> None:
    assert PROGRAM["run_example"](path, tmp_path / path.stem).stat().st_size > 1000
