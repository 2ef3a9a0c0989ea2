"""Records: frozen dataclasses read from the tables that JSON and TOML hold, and written as such.

The range of a value stands at its field, `Annotated[int, Meta(ge=1)]`, or `Annotated[float, Meta(ge=0)] | None` where
it may be missing. tyro derives command lines from the same classes and ignores ranges; `check_record` applies them.
"""

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta

from shinypartial.core.errors import InputError

Record = TypeVar("Record")

Count = Annotated[int, Meta(ge=1)]
Natural = Annotated[int, Meta(ge=0)]
NonNegative = Annotated[float, Meta(ge=0)]
Positive = Annotated[float, Meta(gt=0)]
Share = Annotated[float, Meta(ge=0, le=1)]
Finite = Annotated[float, Meta(description="any finite number")]
"""For numbers that may be negative, which says that no range was forgotten."""
Text = Annotated[str, Meta(pattern=r"\S")]
Item = TypeVar("Item")
NonEmpty = Annotated[tuple[Item, ...], Meta(min_length=1)]

NOUNS = {int: "a whole number", float: "a number", str: "a text", bool: "true or false", Path: "a path"}


def read_record(
    cls: type[Record],
    content: Any,
    what: str,
    *,
    allow_unknown: bool = False,
    complete: bool = False,
    remedy: str = "Correct that value.",
    place: Callable[[str], str] | None = None,
) -> Record:
    """Build dataclass `cls` from nested tables; `what` names their origin in messages, such as a file.

    Fields may be dataclasses, tuples, Literals, Paths, numbers and texts, each also `| None`. A union of dataclasses is
    distinguished by the field `kind`, whose default names the class. Keys that are missing take the field's default
    (`complete`: every key must be there); unknown keys are refused unless `allow_unknown`, and empty lists where a
    field is `NonEmpty`.

    Raises InputError that names the field, such as `camera.azimuth_deg.0` (`place` may word that), and what is allowed
    there, for values that are missing, unknown, of another type, not finite or out of range.
    """
    return _Reader(what, allow_unknown, complete, remedy, place).value(cls, content, "")


def write_record(instance: Any) -> dict[str, Any]:
    """A dataclass as nested dictionaries, lists, numbers, texts and None: what strict JSON holds."""
    return _plain(instance)


def check_record(instance: Any, what: str, *, place: Callable[[str], str] | None = None, remedy: str) -> None:
    """Raise InputError, as `read_record` does, when a value of a dataclass is out of its field's range."""
    read_record(type(instance), write_record(instance), what, remedy=remedy, place=place)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {item.name: _plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, Path):
        return str(value)
    return value.item() if hasattr(value, "item") else value


@dataclasses.dataclass(frozen=True)
class _Reader:
    what: str
    allow_unknown: bool
    complete: bool
    remedy: str
    place: Callable[[str], str] | None

    def value(self, hint: Any, content: Any, path: str) -> Any:
        """Dataclasses and tuples key by key, so that messages name the place; msgspec judges everything else."""
        options = _options(hint)
        if content is None and types.NoneType in options:
            return None
        records = [option for option in options if dataclasses.is_dataclass(option)]
        if records:
            return self._record(self._choose(records, content, path), content, path)
        sequence = next((option for option in options if typing.get_origin(option) is tuple), None)
        if sequence is not None:
            found = self._tuple(typing.get_args(sequence), content, path)
            if not found and _metas(hint):
                raise self._error(path, _description(hint), "an empty list")
            return found
        try:
            found = msgspec.convert(content, hint, dec_hook=_path)
        except (msgspec.ValidationError, TypeError):
            raise self._error(path, _description(hint), repr(content)) from None
        self._require_finite(found, _description(hint), path)
        return found

    def _require_finite(self, found: Any, expected: str, path: str) -> None:
        """Also within lists and dictionaries, which msgspec judges as a whole and with infinity in their ranges."""
        if isinstance(found, float) and not math.isfinite(found):
            raise self._error(path, expected, repr(found))
        entries = found.items() if isinstance(found, dict) else enumerate(found) if isinstance(found, list) else ()
        for key, entry in entries:
            self._require_finite(entry, "a finite number", _below(path, str(key)))

    def _choose(self, records: list[Any], content: Any, path: str) -> Any:
        if len(records) == 1 or not isinstance(content, dict):
            return records[0]
        by_kind = {record.kind: record for record in records}
        kind = content.get("kind")
        if not isinstance(kind, str) or kind not in by_kind:
            raise self._error(_below(path, "kind"), f"one of {', '.join(by_kind)}", repr(kind))
        return by_kind[kind]

    def _record(self, cls: Any, content: Any, path: str) -> Any:
        if not isinstance(content, dict):
            raise self._error(path, "a table", repr(content))
        fields, hints = {item.name: item for item in dataclasses.fields(cls)}, _hints(cls)
        unknown = [str(key) for key in content if key not in fields]
        if unknown and not self.allow_unknown:
            raise self._error(_below(path, min(unknown)), f"one of the keys {', '.join(fields)}", "an unknown key")
        values = {}
        for name, item in fields.items():
            if name in content:
                values[name] = self.value(hints[name], content[name], _below(path, name))
            elif self.complete or (item.default is item.default_factory is dataclasses.MISSING):
                raise self._error(_below(path, name), _description(hints[name]), "nothing")
        return cls(**values)

    def _tuple(self, hints: tuple[Any, ...], content: Any, path: str) -> tuple[Any, ...]:
        if not isinstance(content, list | tuple):
            raise self._error(path, "a list", repr(content))
        if hints[-1] is Ellipsis:
            hints = hints[:1] * len(content)
        if len(content) != len(hints):
            raise self._error(path, f"{len(hints)} values", f"{len(content)}")
        pairs = enumerate(zip(hints, content, strict=True))
        return tuple(self.value(hint, entry, _below(path, str(index))) for index, (hint, entry) in pairs)

    def _error(self, path: str, expected: str, found: str) -> InputError:
        if self.place:
            where = self.place(path)
        else:
            where = f"`{path}` of {self.what}" if path else self.what
        return InputError(expected=f"{where}: {expected}", found=found, remedy=self.remedy)


def _below(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


@functools.cache
def _hints(cls: Any) -> dict[str, Any]:
    return typing.get_type_hints(cls, include_extras=True)


def _options(hint: Any) -> tuple[Any, ...]:
    """The members of a union, or the type itself; annotations such as tyro's are set aside."""
    if typing.get_origin(hint) is Annotated:
        return _options(typing.get_args(hint)[0])
    return typing.get_args(hint) if typing.get_origin(hint) in (types.UnionType, typing.Union) else (hint,)


def _metas(hint: Any) -> list[Meta]:
    """The ranges at a field; a list's can only be that it is not empty."""
    return [extra for extra in getattr(hint, "__metadata__", ()) if isinstance(extra, Meta)]


def _path(kind: Any, content: Any) -> Any:
    if kind is Path and isinstance(content, str | Path):
        return Path(content)
    raise TypeError(kind)


def _description(hint: Any) -> str:
    """What a field takes, in words: `a whole number of at least 1`, `one of plane, surfels`."""
    if typing.get_origin(hint) is Annotated:
        kind = typing.get_args(hint)[0]
        return _description(kind) + "".join(map(_range, _metas(hint)))
    if typing.get_origin(hint) is Literal:
        return f"one of {', '.join(map(str, typing.get_args(hint)))}"
    options = _options(hint)
    if len(options) > 1:
        return " or ".join("none" if option is types.NoneType else _description(option) for option in options)
    if typing.get_origin(hint) in (tuple, list):
        return "a list"
    if typing.get_origin(hint) is dict:
        entry = typing.get_args(hint)[1]
        return "a table" if entry is Any else f"a table with {_description(entry)} for each key"
    return "a table" if dataclasses.is_dataclass(hint) else NOUNS.get(hint, "a value")


def _range(meta: Meta) -> str:
    if meta.pattern or meta.min_length:
        return " that is not empty"
    if meta.ge is not None and meta.le is not None:
        return f" from {meta.ge:g} to {meta.le:g}"
    bounds = {"of at least": meta.ge, "above": meta.gt, "of at most": meta.le, "below": meta.lt}
    words = [f"{word} {bound:g}" for word, bound in bounds.items() if bound is not None]
    return " " + " and ".join(words) if words else ""
