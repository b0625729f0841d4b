"""What every command shares: errors as one line, Ctrl-C, files written aside and renamed."""

import contextlib
import errno
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from kpc.format.errors import KpcError, UsageError


def run(command: Callable[[list[str]], None], name: str, argv: list[str] | None = None) -> int:
    """Call `command(argv)` and turn what it raises into an exit code.

    0: done. 1: a KpcError or an error of the operating system that names a file, printed as one line on stderr.
    2: a usage error. 130: interrupted. Anything else is a bug and is raised on, with its traceback.
    """
    try:
        command(sys.argv[1:] if argv is None else argv)
    except UsageError as error:
        return _fail(name, str(error), 2)
    except KpcError as error:
        return _fail(name, str(error), 1)
    except KeyboardInterrupt:
        return _fail(name, "interrupted", 130)
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output has gone: nothing is left to tell it
        return 1
    except OSError as error:
        if error.filename is None and error.errno != errno.ENOSPC:
            raise
        where = f"{error.filename}: " if error.filename is not None else ""
        return _fail(name, f"{where}{error.strerror or error}", 1)
    return 0


def _fail(name: str, message: str, code: int) -> int:
    print(f"{name}: {' '.join(message.split())}", file=sys.stderr)
    return code


@contextlib.contextmanager
def written_aside(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside `path`; rename it to `path` on success, delete it on any failure.

    A reader of `path` therefore never sees a half-written file. The temporary keeps the suffix, since writers choose
    their container by it.
    """
    target = Path(path)
    handle, name = tempfile.mkstemp(prefix=f".{target.stem}.", suffix=target.suffix, dir=target.parent)
    os.close(handle)
    aside = Path(name)
    try:
        yield aside
        umask = os.umask(0)
        os.umask(umask)
        aside.chmod(0o666 & ~umask)  # mkstemp makes it private
        os.replace(aside, target)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
