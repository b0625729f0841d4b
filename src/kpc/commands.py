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
        code = import_module(module).main(argv)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler and argv is None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback while the interpreter shuts down
    return int(code)


kpenc = partial(_run, "kpenc", "kpc.encoder")
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
