"""What pyproject.toml cannot state: recipes of scenes inside the wheel, and a README without relative links."""

import re
import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

RECIPES = Path("blender_scenes")
PICTURE = re.compile(r"^!\[[^\]]*\]\((?!https?:)[^)]*\)\n+(\*.*?\n\n)?", re.MULTILINE | re.DOTALL)
SITE = re.compile(r"^## Documentation\n.*?(?=^The method starts)", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[([^\]]+)\]\((?!https?:)[^)]*\)")


class BuildWithRecipes(build_py):
    """An editable install reads `blender_scenes/` where it is."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            shutil.copytree(RECIPES, Path(self.build_lib) / "shinypartial/data" / RECIPES, dirs_exist_ok=True)


def page(readme: str) -> str:
    """For a package page, which has neither the pictures nor the documentation beside it."""
    return LINK.sub(r"\1", PICTURE.sub("", SITE.sub("", readme)))


setup(
    cmdclass={"build_py": BuildWithRecipes},
    long_description=page(Path("README.md").read_text(encoding="utf-8")),
    long_description_content_type="text/markdown",
)
