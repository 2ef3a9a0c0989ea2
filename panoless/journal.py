"""What a fit has finished, on disk: a later run of the same command takes it from there.

A function that is `remembered` is computed once in a run folder. Its result lies in a file that is named after
everything it was given, so whatever differs (photographs, options, a decision before, the last digit of a number) is
recomputed. Outside of a run folder it is computed whenever it is called.
"""

import functools
import hashlib
import inspect
import io
import shutil
import time
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from importlib import import_module
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

import panoless
from panoless.deadline import check_time, is_past_limit
from shinypartial.io.events import begin_stage
from shinypartial.io.files import atomic_write
from shinypartial.io.progress import Progress

FOLDER = "journal"
Given = ParamSpec("Given")
Result = TypeVar("Result")
_hashes: MutableMapping[Tensor, tuple[int, str]] = WeakIdKeyDictionary()
"""Of tensors, at a version of their content: views share theirs with the views that they are corrected from."""


@dataclass
class Journal:
    """The finished stages in one folder. Those that led to a longer one are deleted when that is finished."""

    folder: Path
    seconds: float = 0.0
    """That went into all that was taken from before, when it was computed."""
    _parts: list[list[Path]] = field(default_factory=lambda: [[]])
    """Files of what was finished within each of the stages at work."""

    def stage(self, name: str, given: dict[str, Any], title: str, compute: Callable[[], Any]) -> Any:
        """What `compute` returns, or what it returned in an earlier run. A file that can't be read counts as none."""
        met: list[object] = []
        content = repr((panoless.__version__, name, _encoded(given, _hash, lambda each: met.append(each))))
        path = self.folder / f"{name.rpartition('.')[2]}-{hashlib.sha256(content.encode()).hexdigest()[:24]}.pt"
        before, start = self.seconds, time.monotonic()
        try:
            stored = torch.load(path, weights_only=True)
            result, seconds = _decoded(stored["result"], met), float(stored["seconds"])
        except Exception:
            begin_stage(title)
        else:
            begin_stage(title, found_before=True)
            self.seconds += seconds
            self._parts[-1].append(path)
            return result
        self._parts.append([])
        try:
            result = compute()
        finally:
            parts = self._parts.pop()
        if is_past_limit():
            self._parts[-1] += parts
            return result
        seconds = time.monotonic() - start + self.seconds - before
        places = {id(each): place for place, each in reversed(list(enumerate(met)))}
        buffer = io.BytesIO()
        torch.save(
            {"result": _encoded(result, _compact, lambda each: places.get(id(each))), "seconds": seconds}, buffer
        )
        with atomic_write(path) as temporary:
            temporary.write_bytes(buffer.getbuffer())
        for part in parts:
            part.unlink(missing_ok=True)
        self._parts[-1].append(path)
        return result


_current: ContextVar[Journal | None] = ContextVar("journal", default=None)


@contextmanager
def journal_in(run: Path) -> Iterator[None]:
    """Remember within this block what is finished."""
    token = _current.set(Journal(run / FOLDER))
    try:
        yield
    finally:
        _current.reset(token)


def forget(run: Path) -> None:
    """Delete what a run remembers, which it no longer needs."""
    shutil.rmtree(run / FOLDER, ignore_errors=True)


def seconds_before() -> float:
    """That all results took which were taken from earlier runs."""
    journal = _current.get()
    return 0.0 if journal is None else journal.seconds


def remembered(
    title: Callable[..., str] = lambda *_, **__: "",
) -> Callable[[Callable[Given, Result]], Callable[Given, Result]]:
    """A function that is computed once in a run folder; `title`, of what it is given, is what a line calls it.

    It has to depend on nothing but what it is given: dataclasses and other objects of fields, arrays, tensors, numbers,
    text, functions by their name. A line of progress does not count. What it returns is of the same kinds; where that
    is an object that it was given, it is the same object later, too.
    """

    def remember(function: Callable[Given, Result]) -> Callable[Given, Result]:
        signature, name = inspect.signature(function), _name(function)

        @functools.wraps(function)
        def call(*args: Given.args, **kwargs: Given.kwargs) -> Result:
            check_time()
            journal = _current.get()
            if journal is None:
                return function(*args, **kwargs)
            bound = signature.bind(*args, **kwargs)
            bound.apply_defaults()
            found: Result = journal.stage(
                name, bound.arguments, title(*args, **kwargs), lambda: function(*args, **kwargs)
            )
            return found

        return call

    return remember


def _name(thing: Any) -> str:
    """Of a class or a function in a module, by which it is imported."""
    name = f"{thing.__module__}.{thing.__qualname__}"
    if "<locals>" in name or inspect.ismethod(thing):
        raise TypeError(f"{name} has no name that identifies it")
    return name


def _encoded(value: Any, tensor: Callable[[Tensor], Any], place: Callable[[object], int | None]) -> Any:
    """A value as lists, plain values and what becomes of tensors; objects that have a `place` by that."""
    again = functools.partial(_encoded, tensor=tensor, place=place)
    if type(value) in (type(None), bool, int, float, str):
        return value
    if type(value) in (list, tuple):
        return [type(value).__name__, [again(each) for each in value]]
    if type(value) is dict:
        return ["dict", [[again(key), again(each)] for key, each in value.items()]]
    if isinstance(value, Progress):
        return None
    if isinstance(value, Enum):
        return ["enum", _name(type(value)), value.name]
    if isinstance(value, type) or inspect.isroutine(value):
        return ["name", _name(value)]
    if (known := place(value)) is not None:
        return ["place", known]
    if isinstance(value, Tensor):
        return ["tensor", tensor(value)]
    if isinstance(value, np.generic):
        return ["number", tensor(torch.from_numpy(np.array(value)))]
    if isinstance(value, np.ndarray):
        return ["array", tensor(torch.from_numpy(value.copy(order="K")))]
    names = [item.name for item in fields(value)] if is_dataclass(value) else list(vars(value))
    return ["object", _name(type(value)), [[name, again(getattr(value, name))] for name in names]]


def _hash(value: Tensor) -> str:
    """Of type, shape, device and content."""
    version, found = _hashes.get(value, (-1, ""))
    if version != value._version:
        content = value.detach().cpu().contiguous()
        found = (
            f"{value.dtype} {tuple(value.shape)} {value.device.type} {hashlib.sha256(content.numpy().data).hexdigest()}"
        )
        _hashes[value] = value._version, found
    return found


def _compact(value: Tensor) -> Tensor:
    """A part of a larger tensor without the rest, which would be written, too."""
    return value.clone() if value.untyped_storage().nbytes() > value.nbytes else value


def _decoded(value: Any, places: list[object]) -> Any:
    """The value from `_encoded`; objects that had a place are those at it."""
    if not isinstance(value, list):
        return value
    kind, *rest = value
    if kind in ("list", "tuple"):
        items = [_decoded(each, places) for each in rest[0]]
        return items if kind == "list" else tuple(items)
    if kind == "dict":
        return {_decoded(key, places): _decoded(each, places) for key, each in rest[0]}
    if kind == "place":
        return places[rest[0]]
    if kind == "tensor":
        return rest[0]
    if kind in ("array", "number"):
        return rest[0].numpy() if kind == "array" else rest[0].numpy()[()]
    if kind == "enum":
        return _named(rest[0])[rest[1]]
    if kind == "name":
        return _named(rest[0])
    found = object.__new__(_named(rest[0]))
    for name, each in rest[1]:
        object.__setattr__(found, name, _decoded(each, places))
    return found


def _named(name: str) -> Any:
    """A class or a function of these packages."""
    module, _, part = name.rpartition(".")
    if not module.startswith(("panoless.", "shinypartial.")):
        raise ValueError(f"{name} is none of ours")
    return getattr(import_module(module), part)
