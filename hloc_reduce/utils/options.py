"""Options from signatures: each is declared once, by a parameter of a function or a dataclass.

The parameters give names, types and defaults, `Args:` in the docstring the help. A parameter that
is a dataclass stands for the options of its fields. Other parameters without a simple type, such as
a dict, are no options, and neither are flags that are set by default.
"""

import argparse
import inspect
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from . import cli
from .cli import InputError, choose

KINDS = (str, Path, float, int, bool)  # of several in an annotation the first one is taken
LISTS = (list, tuple, Iterable, Collection, Sequence)
REQUIRED = inspect.Parameter.empty


@dataclass(frozen=True)
class Option:
    """What a parameter has beyond its type, as in `Annotated[str, Option(...)]`.

    Args:
        kind: what messages call a value, such as "matcher".
        choices: the allowed values. If the parameter is not a string, the value of the chosen key.
        note: help on the choices.
        least: the least number.
        above: what numbers must exceed.
        repeated: one value each time that the option is given, not several at once.
        flags: names instead of `--<parameter>`; a name without dashes is given by its position.
        metavar: stands for the value in the help.
    """

    kind: str = ""
    choices: Collection[str] = ()
    note: str = ""
    least: float | None = None
    above: float | None = None
    repeated: bool = False
    flags: tuple[str, ...] = ()
    metavar: str | None = None


POSITIVE, ABOVE_0 = Option(least=1), Option(above=0)


@dataclass(frozen=True)
class Parameter:
    """A parameter.

    Its `kind` is one of `KINDS`, a dataclass, object for a key of choices, or None for others.
    """

    name: str
    kind: type | None
    several: bool
    option: Option
    default: Any
    text: str

    def check(self, values: Any, what: str) -> None:
        """Raise an InputError, which begins with `what`, for a wrong value."""
        choices, least, above = self.option.choices, self.option.least, self.option.above
        for value in values if isinstance(values, list | tuple) else [values]:
            if isinstance(value, str) and choices:
                choose(self.option.kind, value, choices)
            if not isinstance(value, int | float):
                continue
            if least is not None and not value >= least:
                raise InputError(f"{what} {value:g}: at least {least:g}.")
            if above is not None and not value > above:
                raise InputError(f"{what} {value:g}: it must be above {above:g}.")

    def help(self) -> str:
        """Return the help; names in backticks are options."""
        text, _, told = self.text.removesuffix(".").partition("; default: ")
        if self.option.choices:
            text += f", one of {', '.join(self.option.choices)}"
        if self.option.note:
            text += f": {self.option.note}"
        if told:
            text += f" (default: {told})"
        return re.sub(r"`(\w+)`", r"--\1", text).replace("`", "").replace("%", "%%")

    def add_to(self, parser: argparse._ActionsContainer) -> None:
        """Add the option to a parser, or to a group of it."""
        option, default = self.option, self.default
        flags = option.flags or (f"--{self.name}",)
        settings: dict[str, Any] = {"help": self.help()}
        if flags[-1].startswith("-"):
            settings |= {"dest": self.name, "required": default is REQUIRED}
        if default is not REQUIRED:
            settings["default"] = list(default) if default and self.several else default
        if self.kind is bool:
            parser.add_argument(*flags, action="store_true", **settings)
            return
        if self.kind in (Path, float, int):
            settings["type"] = self.kind
        elif self.kind is object and isinstance(option.choices, Mapping):
            keys = [key for key, value in option.choices.items() if value == default]
            settings |= {"default": keys[0]} if keys else {}
        if self.several:
            settings |= {"action": "append"} if option.repeated else {"nargs": "+"}
        metavar = option.metavar or flags[-1].strip("-").upper()
        parser.add_argument(*flags, metavar=metavar, **settings)


@cache
def parameters(source: Callable) -> dict[str, Parameter]:
    """Return the parameters of a function or a dataclass by name."""
    hints, texts = get_type_hints(source, include_extras=True), _texts(source)
    return {
        name: Parameter(name, *_kind(hints[name]), parameter.default, texts.get(name, ""))
        for name, parameter in inspect.signature(source).parameters.items()
        if parameter.kind != parameter.VAR_KEYWORD
    }


def _kind(annotation: Any) -> tuple[type | None, bool, Option]:
    """Return the kind of an annotation, whether it has several values, and its `Option`."""
    members = [*_members(annotation)]
    single = {kind: option for kind, several, option in members if not several}
    lists = {kind: option for kind, several, option in members if several}
    several = bool(lists) and Path not in single  # a file may list names
    kinds = lists if several else single
    kind = next((kind for kind in (*KINDS, *kinds) if kind in kinds), None)
    return kind, several, kinds[kind] if kind else Option()


def _members(annotation: Any) -> Iterator[tuple[type, bool, Option]]:
    """Yield the kinds that a value may have, as in `_kind`, but for types that are no options."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        for kind, several, _ in [*_members(parts[0])] or [(object, False, None)]:
            yield kind, several, parts[1]
    elif origin in (Union, UnionType):
        for part in parts:
            yield from _members(part)
    elif annotation in KINDS or is_dataclass(annotation):
        yield annotation, False, Option()
    elif origin in LISTS and parts[1:] in ((), (...,)):
        yield from (
            (kind, True, option) for kind, nested, option in _members(parts[0]) if not nested
        )


def _texts(source: Callable) -> dict[str, str]:
    """Return what docstrings say about parameters; that of a class also has those of its bases."""
    texts: dict[str, str] = {}
    for documented in reversed(source.__mro__) if isinstance(source, type) else [source]:
        _, _, after = inspect.cleandoc(documented.__doc__ or "").partition("\nArgs:\n")
        arguments = re.split(r"^\S", after, maxsplit=1, flags=re.MULTILINE)[0]
        for name, text in re.findall(r"^    (\w+): (.*(?:\n     .*)*)", arguments, re.MULTILINE):
            texts[name] = " ".join(text.split())
    return texts


class Parser(cli.Parser):
    """A command line whose options are parameters of functions and dataclasses."""

    def __init__(self, description: str | None, example: str = "", **settings: Any):
        super().__init__(description, example, **settings)
        self._added: list[Parameter] = []

    def add(
        self,
        source: Callable,
        without: Collection[str] = (),
        exclusive: Collection[tuple[str, ...]] = (),
        **defaults: Any,
    ) -> None:
        """Add options.

        Args:
            source: the function or the dataclass.
            without: its parameters that are no options.
            exclusive: groups of parameters of which one may be given.
            defaults: other defaults of options.
        """
        groups = {group: self.add_mutually_exclusive_group() for group in exclusive}
        for name, parameter in parameters(source).items():
            default = defaults.get(name, parameter.default)
            if is_dataclass(parameter.kind):
                self.add(parameter.kind, without, **flat(default))
            elif parameter.kind and name not in without and default is not True:
                parameter = replace(parameter, default=default)
                group = next((group for names, group in groups.items() if name in names), self)
                parameter.add_to(group)
                self._added.append(parameter)

    def read(self) -> dict[str, Any]:
        """Parse and check the options and return them by the names of the parameters.

        Raises:
            InputError: for a wrong value.
        """
        values = vars(self.parse_args())
        for parameter in self._added:
            value, (*_, flag) = values[parameter.name], (parameter.name, *parameter.option.flags)
            parameter.check(value, f"--{flag.strip('-')}")
            if parameter.kind is object and isinstance(value, str):
                values[parameter.name] = dict(parameter.option.choices)[value]
        return values


def call(main: Callable, description: str | None, example: str = "", **settings: Any) -> Any:
    """Call a function with the options of its command line, as of `Parser.add`."""
    parser = Parser(description, example)
    parser.add(main, **settings)
    return main(**taken(main, parser.read()))


def taken(source: Callable, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return those of the options that a function or a dataclass takes, as its arguments."""
    arguments = {}
    for name, parameter in parameters(source).items():
        if is_dataclass(parameter.kind):
            arguments[name] = replace(parameter.default, **taken(parameter.kind, values))
        elif name in values:
            arguments[name] = values[name]
    return arguments


def flat(instance: Any) -> dict[str, Any]:
    """Return the fields of a dataclass by name, and those of dataclasses in it instead of these."""
    values: dict[str, Any] = {}
    for name, parameter in parameters(type(instance)).items():
        value = getattr(instance, name)
        values |= flat(value) if is_dataclass(parameter.kind) else {name: value}
    return values


class Checked:
    """A base of frozen dataclasses: strings become paths, and values are checked.

    Raises:
        InputError: for a wrong value.
    """

    def __post_init__(self) -> None:
        for name, parameter in parameters(type(self)).items():
            value = getattr(self, name)
            if parameter.kind is Path and isinstance(value, str):
                object.__setattr__(self, name, Path(value))
            parameter.check(value, f"{name} is")
