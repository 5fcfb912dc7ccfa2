"""What all command lines do alike."""

from pathlib import Path

import pytest

from hloc_reduce.utils import cli


def test_options_must_be_spelled_out(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["python -m place"])
    parser = cli.Parser("Do something.", "sub --min_confidence 3 photos/*")
    add = parser.add_subparsers().add_parser
    for command in (parser, add("sub", description="Do a part.", example="--min_confidence 3")):
        command.add_argument("--min_confidence", type=float, default=8.0, help="least confidence")
    for arguments in (["--min_conf", "3"], ["sub", "--min_conf", "3"], ["--min_confidence", "x"]):
        with pytest.raises(SystemExit) as exit:
            parser.parse_args(arguments)
        assert exit.value.code == 2 and "usage: python -m place" in capsys.readouterr().err
    text = parser.format_help()
    assert "least confidence (default: 8.0)" in text
    assert text.endswith("\nexample: python -m place sub --min_confidence 3 photos/*\n")
    with pytest.raises(SystemExit):
        parser.parse_args(["sub", "--help"])
    assert "example: python -m place sub --min_confidence 3\n" in capsys.readouterr().out


def test_every_command_line_is_such_a_parser():
    root = Path(__file__).parents[2]
    tops = ("hloc_reduce", "pipelines", "benchmarks")
    paths = [path for top in tops for path in (root / top).rglob("*.py")]
    made = [path.name for path in paths if "argparse.ArgumentParser(" in path.read_text()]
    assert len(paths) > 100 and made == []


def test_packages_that_a_robot_does_without(caplog):
    """Are named in a line; other missing packages are defects, and shown as such."""

    def needs(name):
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    with pytest.raises(SystemExit) as exit:
        cli.run(lambda: needs("torch"))
    assert exit.value.code == 2 and "This needs torch, which is not installed" in caplog.text
    with pytest.raises(ModuleNotFoundError):
        cli.run(lambda: needs("numpi"))
