"""The entry points of the commands. Each loads its module, which takes seconds, while Ctrl-C already ends it."""

import os
import sys

try:
    import signal
    from functools import partial
    from importlib import import_module

    from kpc.format.common import interrupts
except KeyboardInterrupt:  # before there is anything that `interrupts` could end
    os.write(2, os.fsencode(f"{os.path.basename(sys.argv[0])}: interrupted\n"))
    sys.exit(130)


def _run(name: str, module: str, argv: list[str] | None = None) -> int:
    """Load a module and return what its `main` returns."""
    with interrupts.ending_at_once(name):
        try:
            main = import_module(module).main
        except ModuleNotFoundError as error:
            main = partial(_lack, name, error)
        code = main(argv)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler and argv is None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback while the interpreter shuts down
    return int(code)


def _lack(name: str, error: ModuleNotFoundError, argv: list[str] | None) -> int:
    """Run a command whose module cannot be loaded: say its version, which needs no extra, or what is missing."""
    from kpc.format.common import cli
    from kpc.format.common.version import VERSION

    def command(words: list[str]) -> None:
        if "--version" not in words:
            raise error
        print(f"{name} {VERSION}")

    return cli.run(command, name, argv)


kpenc = partial(_run, "kpenc", "kpc.encoder.cli.kpenc")
kpposes = partial(_run, "kpposes", "kpc.encoder.cli.kpposes")
kpplay = partial(_run, "kpplay", "kpc.player.app.kpplay")
kprender = partial(_run, "kprender", "kpc.tools.cli.kprender")
kpinfo = partial(_run, "kpinfo", "kpc.tools.cli.kpinfo")
kpjoin = partial(_run, "kpjoin", "kpc.tools.cli.kpjoin")
kpedit = partial(_run, "kpedit", "kpc.tools.cli.kpedit")
kpshare = partial(_run, "kpshare", "kpc.tools.cli.kpshare")
kpexport = partial(_run, "kpexport", "kpc.tools.cli.kpexport")
kpbench = partial(_run, "kpbench", "kpc.tools.bench.kpbench")
kpbatch = partial(_run, "kpbatch", "kpc.tools.cli.kpbatch")
