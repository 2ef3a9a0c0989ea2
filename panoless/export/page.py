"""One self-contained page about a light: what was found, how far to trust it, and what to do with the files."""

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from shinypartial.io.files import write_text

STYLE = """body{font:16px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;color:#222;
background:#fafafa}img{width:100%;border-radius:6px}figure{margin:1.5rem 0}figcaption{color:#555}
.verdict{padding:.8rem 1rem;border-radius:6px;background:#e7f4e8}.verdict.partly{background:#fdf3d7}
.verdict.not{background:#fbe3e0}code{background:#eee;padding:.1rem .3rem;border-radius:4px}"""


def write_page(
    path: Path,
    title: str,
    verdict: tuple[str, str],
    lines: Sequence[str],
    pictures: Mapping[Path, str],
    files: Mapping[str, str],
) -> None:
    """Write `path`: the word of a verdict and its sentence, a line each of what was found, JPEG pictures with their
    captions, and files with what each is for. All text is escaped, all pictures are inside.
    """
    word, sentence = verdict
    kind = {"trust": "", "partly": " partly"}.get(word, " not")
    shown = "".join(
        f'<figure><img alt="{escape(caption)}" src="data:image/jpeg;base64,'
        f'{base64.b64encode(picture.read_bytes()).decode()}"><figcaption>{escape(caption)}</figcaption></figure>'
        for picture, caption in pictures.items()
        if picture.is_file()
    )
    found = "".join(f"<li>{escape(line)}</li>" for line in lines)
    listed = "".join(f"<li><code>{escape(name)}</code> {escape(what)}</li>" for name, what in files.items())
    write_text(
        path,
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title><style>{STYLE}</style>'
        f'<h1>{escape(title)}</h1><p class="verdict{kind}">{escape(sentence)}</p>{shown}'
        f"<h2>What was found</h2><ul>{found}</ul><h2>Files</h2><ul>{listed}</ul></html>\n",
    )
