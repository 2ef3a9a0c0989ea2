"""Pages from templates: jinja2 with autoescape, so that no name in a file can write into a page."""

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shinypartial.core.errors import InputError
from shinypartial.io.files import write_text

if TYPE_CHECKING:
    from jinja2 import Environment

TEMPLATES = Path(__file__).parent / "templates"


@functools.cache
def _environment() -> "Environment":
    import jinja2

    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def render(template: str, **values: Any) -> str:
    """The text of a template; what stands in `values` is escaped where it appears."""
    return _environment().get_template(template).render(values)


def trusted(markup: str) -> str:
    """Mark text that a template or matplotlib made as HTML, so that it is not escaped again."""
    from markupsafe import Markup

    return Markup(markup)


def require_own_page(page: Path, generator: str) -> None:
    """InputError when `page` exists and was not made by the command `generator`; pages name theirs."""
    if page.exists() and f'content="shinypartial {generator}"' not in page.read_text("utf-8", errors="replace"):
        raise InputError(
            expected=f"a new folder or an earlier {generator} at {page.parent}",
            found=f"a {page.name} of something else",
            remedy="Choose another --output.",
        )


def write_page(page: Path, template: str, **values: Any) -> Path:
    """Write a page that needs no other file; return its path."""
    write_text(page, render(template, **values))
    return page
