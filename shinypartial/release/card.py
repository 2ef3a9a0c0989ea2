"""The dataset card of a release: what the data is, how it was made, how to load it, under which licenses."""

import json
from collections.abc import Iterator, Sequence
from typing import Any

from shinypartial.dataset.schema import CHECKSUMS, LICENSES, Dataset
from shinypartial.release.publication import (
    CROISSANT,
    DATA,
    Archive,
    Publication,
    license_names,
    license_rows,
    top_pictures,
)

#: Identifiers that the Hugging Face Hub knows under the lower-case SPDX name.
HUB_LICENSES = ("apache-2.0", "bsd-3-clause", "cc-by-4.0", "cc-by-nc-4.0", "cc-by-sa-4.0", "cc0-1.0", "mit")
SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"))
LONGEST_CELL = 100
SUMMARY = (
    "Photographs, taken from one side only, of objects that mirror their surroundings, with the environment that they "
    "reflect, world normals, depth and masks as exact ground truth. The task is to recover the environment and the "
    "shape from the training views, and to say how well each direction was observed."
)
SOFTWARE_CITATION = (
    "The panoless contributors. panoless and shinypartial: recovering an environment from partial reflections, with a "
    "benchmark."
)


def description(datasets: Sequence[Dataset]) -> str:
    """The release in one paragraph."""
    return f"{SUMMARY} {len(datasets)} {'dataset' if len(datasets) == 1 else 'datasets'}, {_views(datasets):,} views."


def citation(publication: Publication) -> str:
    """The release as a BibTeX entry."""
    fields = {
        "title": f"{publication.name}, version {publication.version}",
        "author": f"{{{publication.creator}}}",
        "year": publication.date[:4],
        "url": publication.url,
        "note": f"Made with: {SOFTWARE_CITATION}",
    }
    lines = [f"  {name} = {{{value}}}" for name, value in fields.items() if value]
    return f"@misc{{{publication.name},\n" + ",\n".join(lines) + "\n}"


def card(publication: Publication, datasets: tuple[Dataset, ...], archives: Sequence[Archive]) -> str:
    """The text of README.md: YAML front matter as the Hugging Face Hub reads it, then Markdown."""
    first = datasets[0].name
    parts = [
        _front_matter(publication, datasets),
        f"# {publication.name}\n\n{SUMMARY}\n\nVersion {publication.version}, {publication.date}, "
        f"{publication.creator}.",
        "## Datasets\n\n" + _datasets_table(datasets, archives),
        *_pictures(datasets),
        _layout(archives),
        "## How it was rendered",
        *([RENDERING] if any("blender" in dataset.manifest["generator"] for dataset in datasets) else []),
        *(_recipe(dataset) for dataset in datasets),
        THE_CONVENTIONS,
        THE_SPLITS,
        _loading(first),
        _verifying(),
        "## Licenses\n\n" + _license_table(datasets),
        f"## Citation\n\n```bibtex\n{citation(publication)}\n```",
    ]
    return "\n\n".join(parts) + "\n"


def _views(datasets: Sequence[Dataset]) -> int:
    return sum(len(dataset.train) + len(dataset.test) for dataset in datasets)


def _front_matter(publication: Publication, datasets: tuple[Dataset, ...]) -> str:
    """Strings are written as JSON, which YAML reads too, so that nothing in a name can break the block."""
    names = license_names(datasets)
    known = [name.lower() for name in names if name.lower() in HUB_LICENSES]
    everything_known = len(known) == len(names)
    views = _views(datasets)
    size = next((text for limit, text in SIZES if views < limit), "100K<n<1M")
    lines = [
        f"pretty_name: {json.dumps(publication.name)}",
        f"license: {json.dumps(known if everything_known else ['other'])}",
        *(
            []
            if everything_known
            else [f"license_name: {json.dumps(' AND '.join(names))}", f"license_link: {LICENSES}"]
        ),
        'task_categories: ["image-to-3d"]',
        'tags: ["inverse-rendering", "environment-map", "specular-reflection", "novel-view-synthesis", "croissant"]',
        f"size_categories: {json.dumps([size])}",
        "viewer: false",
    ]
    return "---\n" + "\n".join(lines) + "\n---"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    cells = [[text.replace("|", "\\|").replace("\n", " ") for text in row] for row in (head, *rows)]
    lines = ["| " + " | ".join(row) + " |" for row in cells]
    return "\n".join([lines[0], "| " + " | ".join("---" for _ in head) + " |", *lines[1:]])


def _datasets_table(datasets: Sequence[Dataset], archives: Sequence[Archive]) -> str:
    rows = []
    for dataset, archive in zip(datasets, archives, strict=True):
        camera = dataset.train[0].camera
        title = str(dataset.manifest["recipe"].get("title", ""))
        counts = (str(len(dataset.train)), str(len(dataset.test)), f"{camera.width} × {camera.height}")
        link = f"[{archive.size / 1e6:,.1f} MB]({archive.name})"
        rows.append((f"[{dataset.name}]({DATA}/{dataset.name})", title, *counts, link))
    return _table(("Dataset", "Title", "Training views", "Test views", "Pixels", "Archive"), rows)


def _pictures(datasets: Sequence[Dataset]) -> Iterator[str]:
    lines = [
        f"![{dataset.name}: {name.removesuffix('.png').replace('_', ' ')}]({DATA}/{dataset.name}/{name})"
        for dataset in datasets
        for name in top_pictures(dataset.root)
    ]
    if lines:
        yield "\n\n".join(lines)


def _layout(archives: Sequence[Archive]) -> str:
    archive = f"`{archives[0].name}`{', …' if len(archives) > 1 else ''}"
    return f"""## Files

| Path | Content |
| --- | --- |
| `{DATA}/NAME/` | a dataset folder, ready to use |
| {archive} | the same folder as one file |
| `{LICENSES}` | a row for each asset: what, license, source |
| `{CROISSANT}` | Croissant 1.1 metadata |
| `{CHECKSUMS}` | checksums of all other files, in the format of sha256sum |

In a dataset folder, `transforms_train.json` and `transforms_test.json` hold the cameras; `train/NAME.exr` and
`test/NAME.exr` the ground truth (linear RGBA premultiplied by alpha, `normal.X` `normal.Y` `normal.Z` in the world
frame, `depth.Z`); PNGs beside them the 8-bit pictures (`NAME.png`, RGBA) and companions (such as `NAME_alpha.png` and
`NAME_normal.png`); `environment/` the environment as lat-long and cube maps; `dataset.json` the complete recipe."""


def _recipe(dataset: Dataset) -> str:
    """Versions and seeds in a line, everything else of the manifest below a fold."""
    manifest = dataset.manifest
    entries = list(_flatten(manifest["recipe"], ""))
    versions = [f"{name} {_plain(value)}" for name, value in _flatten(manifest["generator"], "")]
    seeds = [f"{name} {_plain(value)}" for name, value in entries if name.rpartition(".")[2] == "seed"]
    rows = [(name, _shorten(_plain(value))) for name, value in entries]
    return (
        f"**{dataset.name}**: {', '.join(versions + seeds)}.\n\n"
        f"<details><summary>The whole recipe</summary>\n\n{_table(('Entry', 'Value'), rows)}\n\n</details>"
    )


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def _shorten(text: str) -> str:
    return text if len(text) <= LONGEST_CELL else f"{text[:LONGEST_CELL]} … (whole in dataset.json)"


def _flatten(content: dict[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for name, value in content.items():
        if isinstance(value, dict) and value:
            yield from _flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


RENDERING = """\
Blender's Cycles renders linear radiance without denoiser, adaptive sampling or view transform; the PNGs are the sRGB
encoding of that radiance clipped to [0, 1]. The CPU renderer repeats itself to a relative difference of 6·10⁻⁵."""

THE_CONVENTIONS = """\
## Conventions

- World: right-handed, +Z up. Cameras in `transforms_*.json`: camera-to-world with OpenGL axes (+x right, +y up, looking
  along −z). Pixel centers lie at +0.5.
- Lat-long maps: row 0 is +Z, the center looks along +X, azimuth falls to the right: u = ½ − atan2(y, x)/2π.
- Cube faces: +X −X +Y −Y +Z −Z, oriented as OpenGL has them. `latlong_yup.exr` is the map for readers that take +Y as
  up.
- Depth is z in the camera, not distance. Normals point out of the surface; in PNGs they are (n + 1)/2."""

THE_SPLITS = """\
## Splits

`train` is what a method may see, together with its cameras. `test` views come from the same side of the object, at
other places; they and `environment/` are for scoring only. There is no validation split: hold out training views for
that."""


def _loading(first: str) -> str:
    return f"""## Loading it

Each folder below `{DATA}/` loads with readers of NeRF-synthetic, Shiny Blender and nerfstudio's Blender data as it
stands: point them to `{DATA}/{first}`. With `shinypartial`, which generated it:

```python
from pathlib import Path

from shinypartial.dataset.read import open_dataset, read_environment, read_view

dataset = open_dataset(Path("{DATA}/{first}"))
view = read_view(dataset.train[0])  # radiance, alpha, normals_world, depth
environment = read_environment(dataset)
```

A prediction for it is scored with `shinypartial evaluate PREDICTION --dataset {DATA}/{first}`. With mlcroissant:

```python
import mlcroissant

records = mlcroissant.Dataset("{CROISSANT}").records("views")
```"""


def _verifying() -> str:
    return f"""## Checking a copy

```
sha256sum --check --quiet {CHECKSUMS}    # transport
shinypartial validate .                   # transport and every promise of the format
```"""


def _license_table(datasets: Sequence[Dataset]) -> str:
    rows = [(row.dataset, row.asset, row.license, row.source) for dataset in datasets for row in license_rows(dataset)]
    return _table(("Dataset", "Asset", "License", "Source"), rows)
