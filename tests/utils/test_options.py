"""Command lines that follow from signatures."""

import argparse
import ast
import importlib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest

from hloc_reduce.utils import options
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.options import ABOVE_0, HIDDEN, POSITIVE, Checked, Option

ROOT = Path(__file__).parents[2]
ELSEWHERE = {"--list_features"}  # of pipelines.aachen
SIZES = {"small": (1, 1), "large": (9, 9)}
Colour = Annotated[str, Option("colour", ("red", "green"), "green is as grass")]


@dataclass(frozen=True)
class Limits(Checked):
    """What is allowed.

    Args:
        most: the most, 100 % by default.
        hidden: what only Python has.
    """

    most: Annotated[float, ABOVE_0] = 100.0
    hidden: Annotated[int, HIDDEN] = 3


@dataclass(frozen=True, kw_only=True)
class Job(Checked):
    """A job.

    Args:
        place: folder of the place.
    """

    place: Path
    colour: Colour | None = None
    limits: Limits = Limits()


@dataclass(frozen=True, kw_only=True)
class Longer(Job):
    """A longer job.

    Args:
        number: how many
            there are; default: as in `place`.
    """

    number: Annotated[int, POSITIVE] | None = None


def work(
    images: Path,
    size: Annotated[tuple, Option("size", SIZES)],
    names: Path | Iterable[str] | None = None,
    prefixes: str | tuple[str, ...] | None = None,
    listed: Annotated[list[Path], Option(repeated=True, flags=("-l", "--list"))] = [],  # noqa: B006
    pairs: Path | Sequence[tuple[str, int]] | None = None,
    conf: dict | None = None,
    checked: bool = True,
    fast: bool = False,
    limits: Limits = Limits(),  # noqa: B008
) -> dict:
    """Work.

    Args:
        images: folder of `names`.
        size: the size.
        names: of images, or a file.
        fast: be fast.

    Returns:
        fast: not an argument.
    """
    return locals()


def run(monkeypatch, *arguments, **settings):
    monkeypatch.setattr("sys.argv", ["work", *map(str, arguments)])
    return options.call(work, "Work.", "--images a", **settings)


def test_arguments_have_the_types_of_the_signature(monkeypatch):
    given = ("--prefixes", "a", "b", "-l", "c", "--list", "d", "--fast", "--most", "2")
    assert run(monkeypatch, "--images", "i", "--names", "n", "--size", "large", *given) == {
        "images": Path("i"),
        "size": (9, 9),
        "names": Path("n"),
        "prefixes": ["a", "b"],
        "listed": [Path("c"), Path("d")],
        "pairs": None,
        "conf": None,
        "checked": True,
        "fast": True,
        "limits": Limits(2.0),
    }
    defaults = run(monkeypatch, "--images", "i", size="small", fast=True, limits=Limits(5.0))
    assert defaults["size"] == (1, 1) and defaults["limits"] == Limits(5.0)


def test_help_is_that_of_the_docstrings(monkeypatch, capsys):
    with pytest.raises(SystemExit):
        run(monkeypatch, "--help", size="small")
    text = " ".join(capsys.readouterr().out.split())
    for said in (
        "--images IMAGES folder of --names",
        "--size SIZE the size, one of small, large (default: small)",
        "-l LIST, --list LIST",
        "--fast be fast --most MOST the most, 100 % by default (default: 100.0)",
        "example: work --images a",
    ):
        assert said in text
    assert not any(word in text for word in ("--conf", "--checked", "hidden"))
    told = {name: p.help() for name, p in options.parameters(Longer).items()}
    assert told["number"] == "how many there are (default: as in --place)"
    assert told["place"] == "folder of the place"
    assert told["colour"] == ", one of red, green: green is as grass"


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("--size", "huge"), "Unknown size 'huge'. There are: large, small."),
        (("--size", "small", "--most", "0"), "--most 0: it must be above 0."),
        (("--size", "small", "--most", "nan"), "--most nan: it must be above 0."),
    ],
)
def test_wrong_values(monkeypatch, arguments, message):
    with pytest.raises(InputError) as error:
        run(monkeypatch, "--images", "i", *arguments)
    assert str(error.value) == message


def test_some_options_exclude_others(monkeypatch, capsys):
    groups = (("names", "pairs"),)
    with pytest.raises(SystemExit) as exit:
        run(monkeypatch, "--images", "i", "--names", "n", "--pairs", "p", exclusive=groups)
    assert exit.value.code == 2 and "not allowed with argument --names" in capsys.readouterr().err


def test_dataclasses_are_checked_and_taken_from_options():
    job = Longer(place="a/b", number=2)
    assert job.place == Path("a/b")
    values = {"place": Path("a/b"), "colour": None, "most": 100.0, "hidden": 3, "number": 2}
    assert options.flat(job) == values
    assert Longer(**options.taken(Longer, values | {"other": 1})) == job
    for wrong, message in (
        ({"number": 0}, "number is 0: at least 1."),
        ({"colour": "blue"}, "Unknown colour 'blue'. There are: "),
    ):
        with pytest.raises(InputError, match=message):
            Longer(place="a", **wrong)
    with pytest.raises(TypeError):
        Longer(place="a", place_=1)


COMMANDS = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for top in ("hloc_reduce", "pipelines")
    for path in (ROOT / top).rglob("*.py")
    if "cli.run(_main)" in path.read_text()
)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_documents_its_options(command, monkeypatch, capsys):
    """Each option has a help text, and those that texts name exist."""
    module = importlib.import_module(command)
    monkeypatch.setattr("sys.argv", [command, "--help"])
    monkeypatch.setattr(options.Parser, "format_help", lambda parser: repr(_documented(parser)))
    with pytest.raises(SystemExit):
        module._main()
    documented = ast.literal_eval(capsys.readouterr().out)
    assert documented and all(text and text != "None" for text in documented.values()), documented
    named = set(re.findall(r"--\w+", " ".join(documented.values())))
    assert named <= documented.keys() | ELSEWHERE


def _documented(parser):
    texts = {}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                texts |= _documented(command)
        texts |= dict.fromkeys(action.option_strings or [str(action.dest)], action.help)
    return {name: str(text) for name, text in texts.items() if name != "==SUPPRESS=="}
