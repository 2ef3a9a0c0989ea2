"""Records survive JSON, and every refusal names the field and what is allowed there."""

import dataclasses
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
import tyro
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Meta

from shinypartial.core.errors import InputError
from shinypartial.io.records import Count, NonEmpty, NonNegative, Share, Text, check_record, read_record, write_record


@dataclass(frozen=True)
class Ball:
    kind: str = "ball"
    radius: NonNegative = 1.0


@dataclass(frozen=True)
class Box:
    kind: str = "box"
    size: tuple[Share, Share] = (0.5, 0.5)


@dataclass(frozen=True)
class Options:
    rays: Annotated[int, Meta(ge=8, le=100)] = 10
    """Most rays."""
    decay: Annotated[float, Meta(ge=0, lt=1)] = 0.5


@dataclass(frozen=True)
class Recipe:
    name: Text
    folder: Path = Path("here")
    count: Annotated[Count, tyro.conf.arg(prefix_name=False)] = 1
    mode: Literal["fast", "best"] = "fast"
    loud: bool = False
    gain: Share | None = None
    steps: tuple[NonNegative, ...] = ()
    seconds: dict[str, NonNegative] = field(default_factory=dict)
    curves: dict[str, list[float]] = field(default_factory=dict)
    config: dict[str, Any] = field(default_factory=dict)
    silhouette: NonEmpty[tuple[float, float]] = ((0.0, 1.0),)
    shape: Ball | Box = Ball()
    parts: tuple[Ball | Box, ...] = ()
    options: Options = field(default_factory=Options)


shares = st.floats(0, 1)
recipes = st.builds(
    Recipe,
    name=st.text(min_size=1).filter(lambda text: bool(text.strip())),
    folder=st.sampled_from([Path("a/b"), Path("/c")]),
    count=st.integers(1, 10**9),
    mode=st.sampled_from(["fast", "best"]),
    loud=st.booleans(),
    gain=st.none() | shares,
    steps=st.lists(st.floats(0, 1e300)).map(tuple),
    curves=st.dictionaries(st.text(), st.lists(st.floats(allow_nan=False, allow_infinity=False))),
    silhouette=st.lists(st.tuples(shares, shares), min_size=1).map(tuple),
    shape=st.builds(Ball, radius=shares) | st.builds(Box, size=st.tuples(shares, shares)),
    parts=st.lists(st.builds(Ball, radius=shares) | st.just(Box())).map(tuple),
    options=st.builds(Options, rays=st.integers(8, 100), decay=st.floats(0, 0.99)),
)


@given(recipes)
def test_a_record_survives_json(recipe: Recipe) -> None:
    content = json.loads(json.dumps(write_record(recipe), allow_nan=False))
    assert read_record(Recipe, content, "r") == recipe
    assert content == write_record(recipe)
    check_record(recipe, "r", remedy="")


REFUSED: dict[str, tuple[dict[str, Any], str, str, str]] = {
    "too small": ({"count": 0}, "`count` of r.toml", "a whole number of at least 1", "0"),
    "too large, nested": ({"options": {"rays": 101}}, "`options.rays`", "a whole number from 8 to 100", "101"),
    "half open": ({"options": {"decay": 1}}, "`options.decay`", "a number of at least 0 and below 1", "1"),
    "text for a number": ({"count": "3"}, "`count`", "a whole number", "'3'"),
    "true is no number": ({"count": True}, "`count`", "a whole number", "True"),
    "number is not true": ({"loud": 1}, "`loud`", "true or false", "1"),
    "fraction": ({"count": 1.5}, "`count`", "a whole number", "1.5"),
    "not a number": ({"gain": math.nan}, "`gain`", "a number from 0 to 1 or none", "nan"),
    "infinite": ({"steps": [1, math.inf]}, "`steps.1`", "a number of at least 0", "inf"),
    "infinite in a dictionary": ({"seconds": {"fit": math.inf}}, "`seconds.fit`", "a finite number", "inf"),
    "no number in lists": ({"curves": {"l1": [0.1, math.nan]}}, "`curves.l1.1`", "a finite number", "nan"),
    "infinite in anything": ({"config": {"a": [{"b": -math.inf}]}}, "`config.a.0.b`", "a finite number", "-inf"),
    "text for a table": ({"seconds": "abc"}, "`seconds`", "a table with a number of at least 0 for each key", "'abc'"),
    "text in a table": ({"seconds": {"a": "b"}}, "`seconds`", "a table with a number of at least 0", "{'a': 'b'}"),
    "text for any table": ({"config": "abc"}, "`config`", "a table", "'abc'"),
    "table of lists": ({"curves": []}, "`curves`", "a table with a list for each key", "[]"),
    "choice": ({"mode": "slow"}, "`mode`", "one of fast, best", "'slow'"),
    "blank": ({"name": " "}, "`name`", "a text that is not empty", "' '"),
    "no path": ({"folder": 3}, "`folder`", "a path", "3"),
    "length": ({"silhouette": [[0, 1], [1, 2, 3]]}, "`silhouette.1`", "2 values", "3"),
    "no list": ({"silhouette": "ab"}, "`silhouette`", "a list", "'ab'"),
    "empty list": ({"silhouette": []}, "`silhouette`", "a list that is not empty", "an empty list"),
    "in a tuple of a union": ({"shape": {"kind": "box", "size": [0, 2]}}, "`shape.size.1`", "from 0 to 1", "2"),
    "kind": ({"parts": [{"kind": "cone"}]}, "`parts.0.kind`", "one of ball, box", "'cone'"),
    "no kind": ({"parts": [{}]}, "`parts.0.kind`", "one of ball, box", "None"),
    "unknown": ({"options": {"beams": 3}}, "`options.beams`", "one of the keys rays, decay", "an unknown key"),
    "no table": ({"options": 3}, "`options`", "a table", "3"),
    "null": ({"options": None}, "`options`", "a table", "None"),
}


@pytest.mark.parametrize(("change", "where", "allowed", "found"), REFUSED.values(), ids=REFUSED.keys())
def test_a_refusal_names_field_range_and_value(change: dict[str, Any], where: str, allowed: str, found: str) -> None:
    with pytest.raises(InputError) as raised:
        read_record(Recipe, {"name": "vase", **change}, "r.toml")
    assert where in raised.value.expected
    assert allowed in raised.value.expected.partition(": ")[2]
    assert raised.value.found == found


def test_a_missing_key_takes_the_default_unless_all_are_asked_for() -> None:
    assert read_record(Recipe, {"name": "vase"}, "r") == Recipe("vase")
    with pytest.raises(InputError, match=r"`name` of r: a text"):
        read_record(Recipe, {}, "r")
    content = write_record(Recipe("vase"))
    del content["options"]["rays"]
    with pytest.raises(InputError, match=r"`options\.rays` of r: a whole number from 8 to 100; found nothing"):
        read_record(Recipe, content, "r", complete=True)


def test_unknown_keys_may_be_allowed() -> None:
    assert read_record(Options, {"rays": 9, "beams": 3}, "r", allow_unknown=True) == Options(rays=9)


def test_the_caller_words_place_and_remedy() -> None:
    recipe = dataclasses.replace(Recipe("vase"), options=Options(rays=7))
    with pytest.raises(InputError) as raised:
        check_record(recipe, "options", place=lambda path: f"--{path}", remedy="See --help.")
    assert raised.value.expected == "--options.rays: a whole number from 8 to 100"
    assert raised.value.remedy == "See --help."


def test_tyro_reads_the_same_classes() -> None:
    assert tyro.cli(Options, args=["--rays", "20"]) == Options(rays=20)
    assert tyro.cli(Recipe, args=["--name", "vase", "--count", "3", "--gain", "0.5", "--options.decay", "0"]) == Recipe(
        "vase", count=3, gain=0.5, options=Options(decay=0.0)
    )
