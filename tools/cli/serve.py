"""serve: a small web server with byte ranges and an adjustable rate and latency, to try streaming.

    python -m kpc.tools.cli.serve FOLDER
    python -m kpc.tools.cli.serve FOLDER --port 9000 --rate 10Mbit --delay 40ms

It serves one folder to this machine only. To publish scenes, use any static file host that supports byte ranges.
"""

import argparse
import re
import sys
import threading
from urllib.parse import quote

from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.common.text import notice
from kpc.player.sharing.file_server import Link, serving


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "serve", argv)


def _command(argv: list[str]) -> None:
    parser = cli.Parser("serve", description="Serve a folder to this machine by HTTP, with byte ranges.")
    cli.add_version_option(parser)
    parser.add_argument("folder", type=cli.named_path, help="the folder to serve")
    parser.add_argument("--port", type=int, default=8000, help="TCP port (default: %(default)s)")
    parser.add_argument(
        "--rate",
        type=_rate,
        default=float("inf"),
        metavar="10Mbit",
        help="bits per second of all requests together (default: unlimited)",
    )
    parser.add_argument(
        "--delay", type=_delay, default=0.0, metavar="40ms", help="delay before every response (default: none)"
    )
    options = parser.parse_args(argv)
    if not options.folder.is_dir():
        raise UsageError(f"{options.folder}: no such folder")
    if not 0 <= options.port < 65536:
        raise UsageError(f"--port {options.port} is not a port number")
    with serving(options.folder, port=options.port, link=Link(options.rate, options.delay)) as url:
        for path in sorted(options.folder.glob("*.kpc")):
            print(f"{url}/{quote(path.name)}", flush=True)
        notice(f"serve: {options.folder} at {url}; press Ctrl-C to stop")
        threading.Event().wait()


def _rate(text: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([kKM]?)bit", text)
    if match is None or float(match[1]) == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a rate; write for example 10Mbit")
    return float(match[1]) * {"": 1, "k": 1e3, "K": 1e3, "M": 1e6}[match[2]] / 8


def _delay(text: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)ms", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a delay; write for example 40ms")
    return float(match[1]) / 1e3


if __name__ == "__main__":
    sys.exit(main())
