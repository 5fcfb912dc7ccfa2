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
LIST_TYPES = (list, tuple, Iterable, Collection, Sequence)
REQUIRED = inspect.Parameter.empty


@dataclass(frozen=True, eq=False)  # annotations must be hashable, and choices may be a dict
class Option:
    """What a parameter has beyond its type, as in `Annotated[str, Option(...)]`.

    Args:
        kind: what messages call a value, such as "matcher".
        choices: the allowed values. If the parameter is not a string, the value of the chosen key.
        note: help on the choices.
        least: the least number.
        above: what numbers must exceed.
        lower: whether upper case means the same.
        repeated: one value each time that the option is given, not several at once.
        rest: whether all arguments that follow are its values.
        number: of its values, if it has several; default: any.
        flags: names instead of `--<parameter>`; a name without dashes is given by its position.
        metavar: stands for the value in the help; with `number`, a word for each value.
        hidden: whether only Python has the parameter.
    """

    kind: str = ""
    choices: Collection[str] = ()
    note: str = ""
    least: float | None = None
    above: float | None = None
    lower: bool = False
    repeated: bool = False
    rest: bool = False
    number: int | None = None
    flags: tuple[str, ...] = ()
    metavar: str | None = None
    hidden: bool = False


POSITIVE, ABOVE_0, HIDDEN = Option(least=1), Option(above=0), Option(hidden=True)


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

    @property
    def flags(self) -> tuple[str, ...]:
        """What the parameter is called on a command line."""
        return self.option.flags or (f"--{self.name}",)

    @property
    def is_option(self) -> bool:
        """Whether command lines have it."""
        return not (self.kind is None or self.option.hidden or self.default is True)

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
        option, default, flags = self.option, self.default, self.flags
        settings: dict[str, Any] = {"help": self.help()}
        metavar = option.metavar
        if flags[-1].startswith("-"):
            metavar = metavar or flags[-1].strip("-").upper()
            settings |= {"dest": self.name, "required": default is REQUIRED}
        if default is not REQUIRED:
            is_list = self.several and default is not None
            settings["default"] = list(default) if is_list else default
        if self.kind is bool:
            parser.add_argument(*flags, action="store_true", **settings)
            return
        if self.kind in (Path, float, int):
            settings["type"] = self.kind
        elif self.kind is object and isinstance(option.choices, Mapping):
            keys = [key for key, value in option.choices.items() if value == default]
            settings |= {"default": keys[0]} if keys else {}
        if option.lower:
            settings["type"] = str.lower
        if self.several:
            nargs: int | str = "*" if settings.get("default") == [] else "+"
            nargs = argparse.REMAINDER if option.rest else option.number or nargs
            settings |= {"action": "append"} if option.repeated else {"nargs": nargs}
        settings["metavar"] = tuple(metavar.split()) if option.number and metavar else metavar
        parser.add_argument(*flags, **settings)


@cache
def parameters(source: Callable) -> dict[str, Parameter]:
    """Return the parameters of a function or a dataclass by name."""
    hints, texts = get_type_hints(source, include_extras=True), _texts(source)
    return {
        name: Parameter(name, *kind_of(hints[name]), parameter.default, texts.get(name, ""))
        for name, parameter in inspect.signature(source).parameters.items()
        if parameter.kind != parameter.VAR_KEYWORD
    }


def declared(source: Callable, **defaults: Any) -> dict[str, Parameter]:
    """Return the options of a function or a dataclass by name, some with other defaults."""
    found: dict[str, Parameter] = {}
    for name, parameter in parameters(source).items():
        default = defaults.get(name, parameter.default)
        if is_dataclass(parameter.kind):
            found |= declared(parameter.kind, **flat(default))
        elif parameter.is_option:
            found[name] = replace(parameter, default=default)
    return found


def kind_of(annotation: Any) -> tuple[type | None, bool, Option]:
    """Return the kind of an annotation, whether it has several values, and its `Option`."""
    members = [*_members(annotation)]
    single = {kind: option for kind, several, option in members if not several}
    lists = {kind: option for kind, several, option in members if several}
    several = bool(lists) and Path not in single  # a file may list names
    kinds = lists if several else single
    kind = next((kind for kind in (*KINDS, *kinds) if kind in kinds), None)
    return kind, several, kinds[kind] if kind else Option()


def _members(annotation: Any) -> Iterator[tuple[type, bool, Option]]:
    """Yield the kinds that a value may have, as in `kind_of`, but for types that are no options."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        for kind, several, _ in [*_members(parts[0])] or [(object, False, Option())]:
            yield kind, several, parts[1]
    elif origin in (Union, UnionType):
        for part in parts:
            yield from _members(part)
    elif annotation in KINDS or is_dataclass(annotation):
        yield annotation, False, Option()
    elif origin in LIST_TYPES and parts[1:] in ((), (...,)):
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
        self._added: dict[str, Parameter] = {}

    def add(
        self,
        source: Callable,
        exclusive: Collection[tuple[str, ...]] = (),
        **defaults: Any,
    ) -> None:
        """Add options, but for those that the command line has already.

        Args:
            source: the function or the dataclass.
            exclusive: groups of parameters of which one may be given.
            defaults: other defaults of options.
        """
        groups = {group: self.add_mutually_exclusive_group() for group in exclusive}
        for name, parameter in declared(source, **defaults).items():
            if name not in self._added:
                group = next((group for names, group in groups.items() if name in names), self)
                parameter.add_to(group)
                self._added[name] = parameter

    def read(self) -> dict[str, Any]:
        """Parse and check the options and return them by the names of the parameters.

        Raises:
            InputError: for a wrong value.
        """
        values = vars(self.parse_args())
        for name, parameter in self._added.items():
            parameter.check(values[name], parameter.flags[-1])
            choices = parameter.option.choices
            if isinstance(choices, Mapping) and parameter.kind is object:
                values[name] = choices.get(values[name])
        return values


def call(main: Callable, description: str | None, example: str = "", **settings: Any) -> Any:
    """Parse a command line by the parameters of a function, and call it; see `Parser.add`."""
    parser = Parser(description, example)
    parser.add(main, **settings)
    return main(**taken(main, parser.read()))


def taken(source: Callable, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return those of the options that a function or a dataclass takes, as its arguments."""
    arguments = {}
    for name, parameter in parameters(source).items():
        if is_dataclass(parameter.kind):
            arguments[name] = replace(parameter.default, **taken(parameter.kind, values))
        elif name in values and parameter.is_option:
            arguments[name] = values[name]
    return arguments


def flat(instance: Any) -> dict[str, Any]:
    """Return the fields of a dataclass by name, and those of dataclasses in it instead of these."""
    values: dict[str, Any] = {}
    kind: Any = type(instance)
    for name, parameter in parameters(kind).items():
        value = getattr(instance, name)
        values |= flat(value) if is_dataclass(parameter.kind) else {name: value}
    return values


class Checked:
    """A base of frozen dataclasses: strings become paths, and values are checked.

    Raises:
        InputError: for a wrong value.
    """

    def __post_init__(self) -> None:
        kind: Any = type(self)
        for name, parameter in parameters(kind).items():
            value = getattr(self, name)
            if parameter.kind is Path and isinstance(value, str):
                object.__setattr__(self, name, Path(value))
            parameter.check(value, f"{name} is")
