"""The file that Blender installs: valid by Blender's own schema, without panoless and torch, GPL; it is enabled."""

import ast
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import bpy
import pytest

from panoless.cli import main
from panoless.export.extension import extension_folder, write_extension
from shinypartial.core.errors import InputError
from tests.architecture.source import undocumented

FILES = sorted(extension_folder().glob("*.py"))
VALIDATOR = Path("addons_core", "bl_pkg", "cli", "blender_ext.py")
#: What Blender itself brings.
ALLOWED = {"bpy", "bpy_extras", "mathutils", "numpy"} | set(sys.stdlib_module_names)

PROGRAM = """
import sys
import bpy
bpy.ops.extensions.package_install_files(filepath=sys.argv[1], repo="user_default", enable_on_install=True)
name = "bl_ext.user_default.panoless"
assert name in bpy.context.preferences.addons, "enabled"
assert not {"torch", "panoless", "shinypartial"} & set(sys.modules)
preferences = bpy.context.preferences.addons[name].preferences
preferences.program = sys.argv[2]
assert bpy.ops.panoless.find_program() == {"FINISHED"}
assert preferences.version.startswith("panoless 0.2.5 at "), preferences.version
try:
    bpy.ops.panoless.light(filepath=sys.argv[3])
except RuntimeError as error:
    print("said", error)
print("works in", bpy.context.scene.panoless.run_folder)
import addon_utils
addon_utils.disable(name)
assert not hasattr(bpy.types.Scene, "panoless")
"""


@pytest.fixture(scope="session")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("package") / "panoless-blender.zip"
    assert main(["extension", "--output", str(path)]) == 0
    return path


def test_blender_itself_finds_it_valid(package: Path) -> None:
    validator = Path(bpy.utils.system_resource("SCRIPTS")) / VALIDATOR
    result = subprocess.run(
        [sys.executable, validator, "validate", package], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr


def test_it_holds_its_license_and_every_module_names_it(package: Path) -> None:
    with zipfile.ZipFile(package) as archive:
        names = archive.namelist()
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
        assert b"GNU GENERAL PUBLIC LICENSE" in archive.read("LICENSE")
    assert {path.name for path in FILES} <= set(names)
    assert manifest["license"] == ["SPDX:GPL-3.0-or-later"]
    assert manifest["blender_version_min"] == "4.2.0"
    for path in FILES:
        assert path.read_text(encoding="utf-8").startswith("# SPDX-License-Identifier: GPL-3.0-or-later\n"), path


def test_equal_sources_make_equal_bytes(package: Path, tmp_path: Path) -> None:
    assert write_extension(tmp_path / "again.zip").read_bytes() == package.read_bytes()
    with pytest.raises(InputError):
        write_extension(tmp_path / "folder")


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_it_needs_nothing_that_blender_lacks(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = {
        alias.name.split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names
    }
    names |= {
        str(node.module).split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and not node.level
    }
    assert names <= ALLOWED


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_public_names_have_a_docstring(path: Path) -> None:
    """They are the tooltips, too."""
    assert list(undocumented(path.read_text(encoding="utf-8"))) == []


def test_blender_installs_it_and_its_preferences_work(package: Path, tmp_path: Path) -> None:
    """In a Blender of its own, in a file that was never saved; panoless is missing its other command there."""
    program = tmp_path / "panoless"
    program.write_text("#!/bin/sh\necho panoless 0.2.5\n", encoding="utf-8")
    program.chmod(0o755)
    dataset = tmp_path / "transforms_train.json"
    dataset.write_text("{}", encoding="utf-8")
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM, package, program, dataset],
        env={**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "blender")},
        capture_output=True,
        text=True,
        check=False,
        timeout=250,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    assert "said Error: panoless stopped without a result" in result.stdout
    assert str(tmp_path / "blender") in result.stdout
    assert "Traceback" not in result.stdout + result.stderr
