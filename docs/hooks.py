"""Hooks of the site: formulas become MathML, and pages and pictures beside `docs` become part of it.

Links are written as they work in the repository; a link that leaves `docs` is rewritten for the site.
"""

import os
import re
from html import unescape
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
FORMULA = re.compile(r'<(?P<tag>div|span) class="arithmatex">\\[\[(](?P<latex>.*?)\\[\])]</(?P=tag)>', re.DOTALL)
LINK = re.compile(r"(?P<before>\]\()(?P<path>[^)#:\s]+)(?P<anchor>#[^)\s]*)?\)")


def beside() -> dict[Path, str]:
    """Files of the repository outside of `docs`, and their address within the site."""
    found = {ROOT / name: name for name in ("CONTRIBUTING.md", "CHANGELOG.md")}
    scenes = ROOT / "blender_scenes"
    found[scenes / "README.md"] = "scenes/index.md"
    for pattern in ("*/preview.png", "*/scene.toml"):
        found |= {path: f"scenes/{path.relative_to(scenes).as_posix()}" for path in scenes.glob(pattern)}
    return found


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the files beside `docs`."""
    for path, address in beside().items():
        files.append(File.generated(config, address, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrite links between `docs` and the files beside it."""
    known, docs = beside(), Path(config.docs_dir)
    source = Path(page.file.abs_src_path)

    def rewritten(match: re.Match[str]) -> str:
        target = (source.parent / match["path"]).resolve()
        address = known.get(target) or (str(target.relative_to(docs)) if target.is_relative_to(docs) else None)
        if address is None or not target.is_file():
            return match[0]
        relative = os.path.relpath(address, os.path.dirname(page.file.src_uri) or ".")
        return f"{match['before']}{relative}{match['anchor'] or ''})"

    return LINK.sub(rewritten, markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Formulas as MathML, which browsers draw without scripts or fonts of ours."""

    def formula(match: re.Match[str]) -> str:
        display = "block" if match["tag"] == "div" else "inline"
        return convert(unescape(match["latex"]).strip(), display=display)

    return FORMULA.sub(formula, html)
