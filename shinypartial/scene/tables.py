"""Nested tables, as TOML and JSON hold them, into frozen dataclasses: every key known, every value in its range."""

import dataclasses
import types
import typing
from dataclasses import dataclass
from typing import Any

from shinypartial.core.errors import InputError


@dataclass(frozen=True)
class Place:
    """Where in which recipe a value stands, for messages."""

    source: str
    key: str = ""

    def below(self, key: str) -> "Place":
        """The place of one entry of the table or list that stands here."""
        return Place(self.source, f"{self.key}.{key}" if self.key else key)

    def error(self, expected: str, found: str) -> InputError:
        """What to raise for the value that stands here."""
        what = f"`{self.key}` of {self.source}" if self.key else self.source
        return InputError(expected=f"{what}: {expected}", found=found, remedy="Correct that value.")


def parse_table(cls: Any, table: Any, place: Place) -> Any:
    """Build dataclass `cls` from a table whose keys must be exactly its fields (those with defaults may miss).

    Raises InputError that names the place of a value which is missing, unknown, of another type or out of range.
    """
    if not isinstance(table, dict):
        raise place.error("a table", repr(table))
    types_by_key = typing.get_type_hints(cls)
    fields = {item.name: item for item in dataclasses.fields(cls)}
    unknown = sorted(table.keys() - fields.keys())
    if unknown:
        raise place.below(unknown[0]).error(f"one of the keys {', '.join(fields)}", "an unknown key")
    values = {}
    for key, item in fields.items():
        if key in table:
            values[key] = _parse_value(types_by_key[key], table[key], item.metadata, place.below(key))
        elif item.default is dataclasses.MISSING:
            raise place.below(key).error("a value", "none")
    return cls(**values)


def _parse_value(kind: Any, value: Any, metadata: Any, place: Place) -> Any:
    if typing.get_origin(kind) is types.UnionType:
        options = typing.get_args(kind)
        some = tuple(option for option in options if option is not types.NoneType)
        if len(some) < len(options) and value is None:
            return None
        return _parse_union(some, value, place) if len(some) > 1 else _parse_value(some[0], value, metadata, place)
    if dataclasses.is_dataclass(kind):
        return parse_table(kind, value, place)
    if typing.get_origin(kind) is tuple:
        return _parse_tuple(typing.get_args(kind), value, metadata, place)
    if kind is str:
        return _parse_text(value, metadata, place)
    if kind is bool:
        if not isinstance(value, bool):
            raise place.error("true or false", repr(value))
        return value
    return _parse_number(kind, value, metadata, place)


def _parse_union(options: tuple[Any, ...], value: Any, place: Place) -> Any:
    """Choose the dataclass whose default `kind` equals the key `kind` of the table."""
    by_kind = {option.kind: option for option in options}
    kind = value.get("kind") if isinstance(value, dict) else None
    if not isinstance(kind, str) or kind not in by_kind:
        raise place.below("kind").error(f"one of {', '.join(by_kind)}", repr(kind))
    return parse_table(by_kind[kind], value, place)


def _parse_tuple(items: tuple[Any, ...], value: Any, metadata: Any, place: Place) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise place.error("a list", repr(value))
    if items[-1] is Ellipsis:
        items = items[:1] * len(value)
    if len(value) != len(items):
        raise place.error(f"{len(items)} values", f"{len(value)}")
    return tuple(
        _parse_value(item, entry, metadata, place.below(str(i)))
        for i, (item, entry) in enumerate(zip(items, value, strict=True))
    )


def _parse_text(value: Any, metadata: Any, place: Place) -> str:
    choices = metadata.get("choices")
    if not isinstance(value, str) or not value.strip():
        raise place.error("a text that is not empty", repr(value))
    if choices and value not in choices:
        raise place.error(f"one of {', '.join(choices)}", repr(value))
    return value


def _parse_number(kind: type, value: Any, metadata: Any, place: Place) -> int | float:
    accepted = (int,) if kind is int else (int, float)
    noun = "a whole number" if kind is int else "a number"
    if isinstance(value, bool) or not isinstance(value, accepted):
        raise place.error(noun, repr(value))
    low, high = metadata["limits"]
    if not low <= value <= high:  # also rejects NaN
        raise place.error(f"{noun} from {low:g} to {high:g}", repr(value))
    return kind(value)
