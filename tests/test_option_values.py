"""Values that options cannot have are refused in words for users, by all parsers of all commands."""

import argparse
import functools
import importlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from kpc import commands
from kpc.format.common import cli
from kpc.format.common.text import byte_text
from kpc.tools.bench import kpbench
from kpc.tools.cli import kpedit

COMMANDS = [one.args[1] for one in vars(commands).values() if isinstance(one, functools.partial)]
PARTS = [[], *([name] for name in kpbench.APART)]


class Found(Exception):
    """Carries a parser out of the command that has just made it."""


def options_of(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yield the options and arguments of a parser and of the parsers of its subcommands."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for one in action.choices.values():
                yield from options_of(one)
        yield action


@pytest.mark.parametrize("module", COMMANDS)
def test_no_message_names_a_function(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(self: argparse.ArgumentParser, *_: object) -> None:
        raise Found(self)

    monkeypatch.setattr(cli.Parser, "parse_args", stop)
    refused = 0
    for words in PARTS if module == kpbench.__name__ else [[]]:
        with pytest.raises(Found) as found:
            importlib.import_module(module).main(words)
        for action in options_of(found.value.args[0]):
            for text in ("", "nan", "x", "-1", "1e999", "\u00b2", "9" * 5000, "k", "=:,"):
                if action.type is None or (action.type is int and action.choices):
                    continue
                try:
                    value = action.type(text)  # type: ignore[operator]
                    assert value != Path(), f"{action.dest}: an empty name is read as the working directory"
                except argparse.ArgumentTypeError as error:  # of another error argparse prints the function's name
                    refused += "invalid" not in str(error)
    assert refused or module.endswith("kpjoin")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["a.kpc", "--from", "-1s"], "argument --from: '-1s' begins with a dash; write --from=-1s"),
        (["a.kpc", "--fro", "-1s", "-o", "b"], "argument --from: '-1s' begins with a dash; write --fro=-1s"),
        (["-o", "-x.kpc"], "argument -o/--output: '-x.kpc' begins with a dash; write -o=-x.kpc"),
        (["a.kpc", "-o"], "argument -o/--output: expected one argument"),
        (["a.kpc", "--from", "--to", "2s"], "argument --from: expected one argument"),
        (["a.kpc", "--from", "--to=2s"], "argument --from: expected one argument"),
        (["a.kpc", "--from=-1s", "-o", "b.kpc"], "argument --from: '-1s' is not a duration"),
    ],
)
def test_a_value_that_begins_with_a_dash_is_named_with_its_remedy(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        kpedit.main(words)
    assert f"kpedit: error: {said}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("count", "text"), [(0, "0 bytes"), (999, "999 bytes"), (20_480, "20.5 KB"), (3e6, "3 MB"), (1.5e9, "1.5 GB")]
)
def test_small_sizes_are_not_rounded_to_none(count: int, text: str) -> None:
    assert byte_text(count) == text


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--psnr", "foo"], "'foo' is not a PSNR; write for example 33dB"),
        (["--view-limits", "azimuth=nan:3"], "'azimuth=nan:3': write finite numbers"),
        (["--steps", "nan"], "'nan' is not a whole number from 1 on"),
        (["--audio-bitrate", "nan"], "'nan' is not a bitrate from 16k to 256k"),
    ],
)
def test_messages_name_what_is_wanted(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        importlib.import_module("kpc.encoder.cli.kpenc").main(["set", "-o", "x.kpc", *words])
    assert said in capsys.readouterr().err
