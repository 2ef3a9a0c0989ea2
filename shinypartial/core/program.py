"""A program of several commands: which there are, its version, help that fits a screen, and the run of one."""

import contextlib
import dataclasses
import io
import re
import sys
import textwrap
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Union, get_type_hints

import tyro

from shinypartial import __version__
from shinypartial.core.errors import parse_and_run

HELP, ALL_HELP = ("-h", "--help"), "--help-all"
WIDTH = 80
#: From the options of a command to those of a field of it, as tyro prints them.
BETWEEN_BOXES = re.compile(
    r"^(?:╰─+╯| +)\n(?:╭─)? [\w.]+ options(?: ─+╮| +\n -+ *)\n(?:(?:[│ ] [^-].*\n)*?[│ ] [─-]+(?: │)?\n)?", re.MULTILINE
)
#: A command line cannot say None where a path or a number is left out.
MARKERS = (tyro.conf.DisallowNone,)


@dataclasses.dataclass(frozen=True)
class Program:
    """Commands by title of their group and by name: dataclasses that run themselves. `examples` are words for each.

    `FIRST`, if a command has it, names the fields that `--help` shows, with dots where they are nested, between spaces.
    `--help-all` shows all of them.
    """

    name: str
    description: str
    groups: Mapping[str, Mapping[str, type]]
    examples: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def main(self, arguments: Sequence[str], defaults: Mapping[str, Any] | None = None) -> int:
        """Parse and run; return 0, 2 for bad usage or bad input, 130 when interrupted.

        `defaults` are instances by the names of their commands.
        """
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="replace")  # Not every terminal and pipe knows ° and ×.
        return parse_and_run(lambda: self.parse(arguments, defaults))

    def parse(self, arguments: Sequence[str], defaults: Mapping[str, Any] | None = None) -> Any:
        """The command that the words state; SystemExit after help, a version and bad usage."""
        arguments, defaults = list(arguments), defaults or {}
        commands = {name: kind for group in self.groups.values() for name, kind in group.items()}
        options = arguments[: arguments.index("--")] if "--" in arguments else arguments
        name = options[0] if options else ""
        if name == "--version":
            print(f"{self.name} {__version__}")
            raise SystemExit(0)
        if not {*HELP, ALL_HELP}.isdisjoint(options):
            if name not in commands:
                print(self.overview())
                raise SystemExit(0)
            print(self._help(name, commands[name], defaults, everything=ALL_HELP in options))
            raise SystemExit(0)
        kinds = [
            Annotated[kind, tyro.conf.subcommand(name, **({"default": defaults[name]} if name in defaults else {}))]
            for name, kind in commands.items()
        ]
        union: Any = Union[tuple(kinds)]  # noqa: UP007
        return tyro.cli(
            union,
            args=arguments,
            prog=self.name,
            description=self.description,
            config=MARKERS,
        )

    def _help(self, name: str, kind: type, defaults: Mapping[str, Any], everything: bool) -> str:
        """What tyro prints of a command; of its first options, if it has such, in a single box."""
        settings: dict[str, Any] = {"default": defaults[name]} if name in defaults else {}
        shown = None if everything else getattr(kind, "FIRST", None)
        if shown:
            kind = _shortened(kind, shown.split())
            settings = {"description": f"{_first_sentence(kind)}.\n{ALL_HELP} lists more options than these."}
        page = io.TextIOWrapper(io.BytesIO(), encoding=sys.stdout.encoding.lower(), errors="replace")
        with contextlib.redirect_stdout(page), contextlib.suppress(SystemExit):
            tyro.cli(kind, prog=f"{self.name} {name}", args=["--help"], config=MARKERS, **settings)
        page.seek(0)
        text = (BETWEEN_BOXES.sub("", page.read()) if shown else page.read()).rstrip()
        return f"{text}\nexample: {self.name} {name} {self.examples[name]}" if name in self.examples else text

    def overview(self) -> str:
        """All commands with a line each, or two."""
        lines = [f"usage: {self.name} COMMAND [--help] [OPTIONS]", f"       {self.name} --version"]
        lines += ["", *textwrap.wrap(self.description, WIDTH)]
        indent = max(len(name) for group in self.groups.values() for name in group) + 4
        for title, group in self.groups.items():
            lines += ["", title]
            for name, kind in group.items():
                first = f"  {name}".ljust(indent)
                lines += textwrap.wrap(
                    _first_sentence(kind), WIDTH, initial_indent=first, subsequent_indent=" " * indent
                )
        return "\n".join(lines)


def _first_sentence(kind: type) -> str:
    """Of what a command is documented with, without its end and what only explains it."""
    return re.split(r"[:;]|\.\s|\.$", kind.__doc__ or "", maxsplit=1)[0]


def _shortened(kind: type, shown: Sequence[str]) -> type:
    """The same dataclass with fields that a command line shows no more, but those."""
    hints = get_type_hints(kind, include_extras=True)
    changed: dict[str, Any] = {}
    defaults: dict[str, Any] = {}
    for each in dataclasses.fields(kind):
        hint = hints[each.name]
        factory: Any = each.default_factory
        below = [name.partition(".")[2] for name in shown if name.startswith(f"{each.name}.")]
        if each.name in shown:
            continue
        if below:
            factory = _shortened(get_type_hints(kind)[each.name], below)
            markers = getattr(hint, "__metadata__", ())
            changed[each.name] = Annotated[(factory, *markers)] if markers else factory
        else:
            changed[each.name] = Annotated[hint, tyro.conf.Suppress]
        if factory is not dataclasses.MISSING:
            defaults[each.name] = dataclasses.field(default_factory=factory)
    body = {"__annotations__": changed, "__doc__": kind.__doc__, "__module__": kind.__module__, **defaults}
    # By keyword alone: a field without a default may stand behind one that is declared again.
    return dataclasses.dataclass(frozen=True, kw_only=True)(type(kind.__name__, (kind,), body))
