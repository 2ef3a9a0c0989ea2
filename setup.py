"""What pyproject.toml cannot state: folders beside the packages in the wheel, and a README without relative links."""

import re
import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

#: Folders of the checkout, and where a wheel has them.
FOLDERS = {"blender_scenes": "shinypartial/data/blender_scenes", "blender_extension": "panoless/blender_extension"}
PICTURE = re.compile(r"^!\[[^\]]*\]\((?!https?:)[^)]*\)\n+(\*.*?\n\n)?", re.MULTILINE | re.DOTALL)
SITE = re.compile(r"^## Documentation\n.*?(?=^## )", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[([^\]]+)\]\((?!https?:)[^)]*\)")


class BuildWithFolders(build_py):
    """An editable install reads them where they are."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            for folder, place in FOLDERS.items():
                ignored = shutil.ignore_patterns("__pycache__")
                shutil.copytree(folder, Path(self.build_lib) / place, ignore=ignored, dirs_exist_ok=True)


def page(readme: str) -> str:
    """For a package page, which has neither the pictures nor the documentation beside it."""
    return LINK.sub(r"\1", PICTURE.sub("", SITE.sub("", readme)))


setup(
    cmdclass={"build_py": BuildWithFolders},
    long_description=page(Path("README.md").read_text(encoding="utf-8")),
    long_description_content_type="text/markdown",
)
