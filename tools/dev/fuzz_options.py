"""The options that all fuzzers have."""

import argparse

from kpc.format.common import cli
from kpc.format.common.errors import UsageError


def fuzz_parser(name: str, description: str, what: str, count: int) -> argparse.ArgumentParser:
    """Return a parser with `--count`, `--first`, `--seed` and `--output`.

    Args:
        name: of the program.
        description: of it, a sentence.
        what: the inputs that it makes, in the plural.
        count: how many it makes by default.
    """
    parser = cli.Parser(name, description=description)
    parser.add_argument("--count", type=int, default=count, help=f"number of {what} (default: %(default)s)")
    parser.add_argument("--first", type=int, default=0, help="number of the first of them (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help=f"other {what} (default: %(default)s)")
    parser.add_argument("-o", "--output", type=cli.named_path, metavar="DIR", help="write what is found here")
    return parser


def check_range(options: argparse.Namespace) -> None:
    """Raise a UsageError if `--count` or `--first` names no inputs."""
    if options.count < 1 or options.first < 0:
        raise UsageError("--count must be positive, and --first not negative")
