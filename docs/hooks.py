"""Hooks of the site: formulas become MathML, and pages and pictures beside `docs` become part of it.

Links are written as they work in the repository; a link that leaves `docs` is rewritten for the site.
"""

import os
import re
from collections.abc import Iterator
from html import unescape
from pathlib import Path

import griffe
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

OPTIONS = "<!-- options -->"
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

    if OPTIONS in markdown:
        markdown = markdown.replace(OPTIONS, "\n".join(option_tables()))
    return LINK.sub(rewritten, markdown)


def option_tables() -> Iterator[str]:
    """Tables of all fields of `FitConfig`, from the source: name on the command line, default, meaning."""
    package = griffe.load("panoless", search_paths=[ROOT], resolve_aliases=True)
    main = package["config.FitConfig"]
    groups = [(main, "config")]
    for item in main.attributes.values():
        nested = package["config"].members.get(str(item.annotation))
        if nested is not None and nested.is_class:
            groups.append((nested, f"config.{item.name}"))
    names = {prefix.removeprefix("config.") for _, prefix in groups}
    for group, prefix in groups:
        yield f"\n### `--{prefix}.…`\n\n{text_of(group)}\n\n| Option | Default | Meaning |\n| --- | --- | --- |"
        for item in group.attributes.values():
            if item.name not in names and "class-attribute" in item.labels:
                option = f"--{prefix}.{item.name}".replace("_", "-").replace("--config.model", "--model")
                yield f"| `{option}` | `{item.value}` | {text_of(item)} |"


def text_of(item: griffe.Object) -> str:
    """A docstring in one line, as a cell of a table."""
    text = item.docstring.value if item.docstring else ""
    return " ".join(text.split()).replace("|", "\\|").replace("*", "\\*")


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Formulas as MathML, which browsers draw without scripts or fonts of ours."""

    def formula(match: re.Match[str]) -> str:
        display = "block" if match["tag"] == "div" else "inline"
        return convert(unescape(match["latex"]).strip(), display=display)

    return FORMULA.sub(formula, html)
