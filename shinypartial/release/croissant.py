"""Croissant 1.1 metadata of a release: JSON-LD that data catalogs and `mlcroissant` read.

Source: the Croissant format specification 1.1, http://mlcommons.org/croissant/1.1.
"""

import re
from collections.abc import Sequence
from typing import Any

from shinypartial.dataset.schema import Dataset
from shinypartial.release.publication import SPDX_IDENTIFIER, Archive, Publication, license_names

CONFORMS_TO = "http://mlcommons.org/croissant/1.1"
ENCODING = {".tar": ["application/x-tar"], ".gz": ["application/x-tar", "application/gzip"]}

#: Terms of the Croissant vocabulary that keep their names.
TERMS = """
    arrayShape citeAs column containedIn equivalentProperty excludes extract field fileObject fileProperty fileSet
    format includes isArray isLiveDataset jsonPath key md5 parentField path recordSet references regex repeated
    replace samplingRate separator source subField transform
"""
CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "name": {"@container": "@language"},
    "description": {"@container": "@language"},
    **{name: f"cr:{name}" for name in TERMS.split()},
}


def croissant(
    publication: Publication,
    description: str,
    citation: str,
    datasets: tuple[Dataset, ...],
    archives: Sequence[Archive],
) -> dict[str, Any]:
    """The metadata as JSON: archives with their checksums, the sets of files in them, pictures as records."""
    references = [{"@id": archive.name} for archive in archives]
    content = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": CONFORMS_TO,
        "name": publication.name,
        "description": description,
        "version": publication.version,
        "datePublished": publication.date,
        "creator": {"@type": "sc:Organization", "name": publication.creator},
        "license": [license_url(name) for name in license_names(datasets)],
        "citeAs": citation,
        "keywords": ["inverse rendering", "environment map", "specular reflection", "novel view synthesis"],
        "isLiveDataset": False,
        "distribution": [
            *(_file_object(archive) for archive in archives),
            _file_set("pictures", "8-bit pictures and companions.", "image/png", "**/*.png", references),
            _file_set("ground-truth", "Linear radiance, normals and depth.", "image/x-exr", "**/*.exr", references),
            _file_set("cameras", "Cameras of each split.", "application/json", "**/transforms_*.json", references),
        ],
        "recordSet": [_pictures()],
    }
    return content if publication.url is None else {**content, "url": publication.url}


def license_url(name: str) -> str:
    """Where SPDX describes a license; a name that is no SPDX identifier stays as it is."""
    return f"https://spdx.org/licenses/{name}.html" if re.fullmatch(SPDX_IDENTIFIER, name) else name


def _file_object(archive: Archive) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": archive.name,
        "name": archive.name.rpartition("/")[2],
        "description": "One dataset folder.",
        "contentUrl": archive.name,
        "contentSize": f"{archive.size} B",
        "encodingFormat": ENCODING["." + archive.name.rpartition(".")[2]],
        "sha256": archive.sha256,
    }


def _file_set(name: str, description: str, encoding: str, includes: str, archives: list[Any]) -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": name,
        "name": name,
        "description": description,
        "containedIn": archives,
        "encodingFormat": encoding,
        "includes": includes,
    }


def _pictures() -> dict[str, Any]:
    def field(name: str, description: str, kind: str, extracted: str) -> dict[str, Any]:
        source = {"fileSet": {"@id": "pictures"}, "extract": {"fileProperty": extracted}}
        identity = {"@type": "cr:Field", "@id": f"views/{name}", "name": name, "description": description}
        return {**identity, "dataType": kind, "source": source}

    return {
        "@type": "cr:RecordSet",
        "@id": "views",
        "name": "views",
        "description": "Every PNG: pictures of the views and their 8-bit companions.",
        "key": {"@id": "views/path"},
        "field": [
            field("path", "Dataset, split and file.", "sc:Text", "fullpath"),
            field("image", "RGBA with straight alpha, sRGB.", "sc:ImageObject", "content"),
        ],
    }
