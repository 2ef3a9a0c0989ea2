"""Hooks of the site: formulas become MathML, and pages and pictures beside `docs` become part of it.

Links are written as they work in the repository; a link that leaves `docs` is rewritten for the site.
"""

import ast
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
DECISIONS = "<!-- decisions -->"
DECIDERS = ("decided", "keep_if_better", "is_clearly_lower", "explains_clearly_more", "is_matte")
"""Functions that accept or refuse by evidence."""
ROOMS = re.compile(r"<!-- rooms of (?P<package>\w+) -->")
ORDER = (
    *("api", "capture", "first_surface", "environment", "geometry", "alignment", "selection"),
    *("trust", "reconstruct", "export"),
    *("core", "io", "scene", "blender", "generate", "dataset", "release", "prediction", "oracle"),
    *(
        "metrics",
        "evaluation",
        "comparison",
        "conversion",
        "report",
        "suites",
        "numeric",
        "kernels",
        "config",
        "presets",
    ),
)
"""Rooms in the order of the data; others come after them."""
ROOT = Path(__file__).resolve().parents[1]
FORMULA = re.compile(r'<(?P<tag>div|span) class="arithmatex">\\[\[(](?P<latex>.*?)\\[\])]</(?P=tag)>', re.DOTALL)
LINK = re.compile(r"(?P<before>\]\()(?P<path>[^)#:\s]+)(?P<anchor>#[^)\s]*)?\)")


GALLERY = ROOT / "docs" / "gallery"


def gallery_page(path: Path) -> str:
    """An example as a page: what its docstring says, its picture, and its code."""
    source = path.read_text(encoding="utf-8")
    text = ast.get_docstring(ast.parse(source)) or ""
    code = source.split('"""', 2)[2].strip()
    shown = sorted((ROOT / "docs" / "images" / "gallery").glob(f"{path.stem}.*"))
    pictures = "".join(f"![What it makes](../images/gallery/{each.name})\n\n" for each in shown)
    return f"{text}\n\n{pictures}```python\n{code}\n```\n"


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
    for path in sorted(GALLERY.glob("*.py")):
        files.append(File.generated(config, f"gallery/{path.stem}.md", content=gallery_page(path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrite links between `docs` and the files beside it."""
    known, docs = beside(), Path(config.docs_dir)
    source = Path(page.file.abs_src_path or docs / page.file.src_uri)

    def rewritten(match: re.Match[str]) -> str:
        target = (source.parent / match["path"]).resolve()
        if target.parent == GALLERY:
            return f"{match['before']}{match['path'].removesuffix('.py')}.md)"
        address = known.get(target) or (str(target.relative_to(docs)) if target.is_relative_to(docs) else None)
        if address is None or not target.is_file():
            return match[0]
        relative = os.path.relpath(address, os.path.dirname(page.file.src_uri) or ".")
        return f"{match['before']}{relative}{match['anchor'] or ''})"

    if OPTIONS in markdown:
        markdown = markdown.replace(OPTIONS, "\n".join(option_tables()))
    if DECISIONS in markdown:
        markdown = markdown.replace(DECISIONS, "\n".join(decision_table()))
    markdown = ROOMS.sub(lambda match: "\n".join(rooms(match["package"])), markdown)
    return LINK.sub(rewritten, markdown)


def rooms(package: str) -> Iterator[str]:
    """Directives that document every room of a package; of the kernels only the public operators."""
    names = {path.stem for path in (ROOT / package).glob("*.py") if not path.stem.startswith("_")}
    names |= {path.parent.name for path in (ROOT / package).glob("*/__init__.py")}
    ranks = {name: rank for rank, name in enumerate(ORDER)}
    for name in sorted(names - {"cli"}, key=lambda name: (ranks.get(name, len(ORDER)), name)):
        yield f"::: {package}.{name}"
        if name == "kernels":
            yield "    options: {show_submodules: false}\n"
            operators = sorted(path.stem for path in (ROOT / package / name).glob("*.py") if path.stem != "__init__")
            yield from (f"::: {package}.{name}.{each}\n    options: {{heading_level: 3}}\n" for each in operators)
        yield ""


def option_tables() -> Iterator[str]:
    """Tables of all fields of `FitConfig`, from the source: name, default, meaning. Those of stages come last."""
    loader = griffe.GriffeLoader(search_paths=[ROOT])
    loader.load("shinypartial")
    package = loader.load("panoless")
    loader.resolve_aliases()
    groups = sorted(option_groups(package["config.FitConfig"], "", tuned=False), key=lambda group: group[2])
    for group, prefix, tuned in groups:
        place, prefix = "" if tuned else "--config.", prefix.replace("splats.", "")
        title = f"--set {prefix}…=" if tuned else f"--config.{prefix}…"
        yield f"\n### `{title}`\n\n{text_of(group)}\n\n| Option | Default | Meaning |\n| --- | --- | --- |"
        for item in group.attributes.values():
            if "class-attribute" in item.labels and nested_options(group, item) is None:
                name = prefix + item.name if tuned else (prefix + item.name).replace("_", "-")
                option = "--model" if name == "model" else place + name
                yield f"| `{option}` | `{' '.join(str(item.value).split())}` | {text_of(item)} |"


def decision_table() -> Iterator[str]:
    """Rows of all calls that accept or refuse: where, by which function, and what the calling function decides."""
    yield "| Place | Test | What is decided |\n|---|---|---|"
    for place, test, meaning in decisions():
        yield f"| `{place}` | `{test}` | {meaning} |"


def decisions() -> Iterator[tuple[str, str, str]]:
    """Function or method of each call of `DECIDERS` in the engine, the one called, and the caller's first sentence."""
    for path in sorted((ROOT / "panoless").rglob("*.py")):
        parts = path.relative_to(ROOT / "panoless").with_suffix("").parts
        if "splats" in parts:
            continue
        module = ast.parse(path.read_text(encoding="utf-8"))
        classes = [each for each in module.body if isinstance(each, ast.ClassDef)]
        for function in (item for each in (module, *classes) for item in each.body):
            if isinstance(function, ast.FunctionDef) and function.name not in DECIDERS:
                text = " ".join((ast.get_docstring(function) or "").split()).replace("|", "\\|")
                meaning = text.partition(". ")[0].rstrip(".")
                yield from ((".".join((*parts, function.name)), each, meaning) for each in _deciders_in(function))


def _deciders_in(function: ast.FunctionDef) -> Iterator[str]:
    """Names of `DECIDERS` that a function calls, as functions or as methods."""
    for node in ast.walk(function):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            if name in DECIDERS:
                yield name


def option_groups(group: griffe.Class, prefix: str, *, tuned: bool) -> Iterator[tuple[griffe.Class, str, bool]]:
    """A class of options and those that it nests, how their fields are named, and whether they are of a stage."""
    yield group, prefix, tuned
    for item in group.attributes.values():
        nested = nested_options(group, item)
        if nested is not None:
            hidden = tuned or str(item.annotation).startswith("Tuned[") or "Suppress" in str(item.annotation)
            yield from option_groups(nested, f"{prefix}{item.name}.", tuned=hidden)


def nested_options(group: griffe.Class, item: griffe.Attribute) -> griffe.Class | None:
    """The class of options that a field holds, or None for a value."""
    name = re.sub(r"^(?:Tuned|Annotated)\[(\w+).*", r"\1", str(item.annotation))
    found = group.module.members.get(name) if name.endswith(("Config", "Options")) else None
    return found.final_target if found is not None and found.is_alias else found  # type: ignore[return-value]


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
