"""What all commands share: one-line errors and exit codes, atomic file writes, and parsers of option values."""

import argparse
import contextlib
import errno
import io
import itertools
import json
import math
import os
import re
import stat
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from kpc.format.common import extras, interrupts
from kpc.format.common.errors import KpcError, UsageError
from kpc.format.common.text import escaped, notice, valid_unicode
from kpc.format.common.version import VERSION

# How addresses begin, such as https://host/ or s3://bucket/.
_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")

# Errors of writing where no space is left, or none that the user may take.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT)

# Seconds by which a time that was typed may be beyond an end and still mean it: durations are shown in hundredths.
TIME_SLACK_S = 0.0051


def run(command: Callable[[list[str]], None], name: str, argv: list[str] | None = None) -> int:
    """Run a command and turn the exceptions it raises into an exit code and one line on stderr.

    Args:
        command: the command, called with its arguments.
        name: of the program, printed before every error.
        argv: its arguments; None for those of the process.

    Returns:
        0 for success; 1 for a KpcError, a package of an extra that is missing, or an error of the operating system that
        names a file or a full disk; 2 for a usage error; 130 after Ctrl-C or SIGTERM. Any other exception is a bug and
        is raised with its traceback.
    """
    _open_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # names may hold what the terminal's encoding lacks
    # Printed when the traceback is gone, and with it what it keeps open, such as bars.
    failure = ("", 0)
    try:
        with interrupts.heeded(name):
            command(sys.argv[1:] if argv is None else argv)
    except UsageError as error:
        failure = str(error), 2
    except KpcError as error:
        failure = str(error), 1
    except ModuleNotFoundError as error:
        remedy = extras.remedy(error.name, name)
        if remedy is None:
            raise
        failure = remedy, 1
    except (KeyboardInterrupt, SystemError) as error:
        # A Ctrl-C that arrives inside a compiled function surfaces as a SystemError.
        if not any(isinstance(cause, KeyboardInterrupt) for cause in _causes(error)):
            raise
        failure = "interrupted", interrupts.INTERRUPTED
    except BrokenPipeError:
        sys.stderr.close()  # The reader of the output is gone; Python must not complain on exit.
        return 1
    except OSError as error:
        said = message_of(error)
        if said is None:
            raise
        failure = said, 1
    message, code = failure
    if code:
        print_error(name, message)
    return code


def _open_closed_streams() -> None:
    """Have standard streams that are closed read and write nothing.

    A file would get their numbers else, and what is meant for them; Python prints on stdout what is meant for none.
    """
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the system gives the lowest number that is free
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))


def message_of(error: KpcError | OSError) -> str | None:
    """Return what to tell the user about an error; None if it is a bug: an OSError without a file or a full disk."""
    if isinstance(error, KpcError):
        return str(error)
    if error.filename is None and error.errno not in NO_ROOM:
        return None
    where = f"{escaped(str(error.filename))}: " if error.filename is not None else ""
    if error.errno == errno.EISDIR:
        return f"{where}is a folder; give the name of a file"
    return f"{where}{error.strerror or error}"


class Parser(argparse.ArgumentParser):
    """A parser of a command's options whose errors are one line; names in them may hold line breaks."""

    _words: Sequence[str] = ()

    def parse_args(  # type: ignore[override]  # overloads of one meaning
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> Any:
        """Parse words as argparse does; files may stand before and after options, but where there are subcommands.

        Behind "--" all are files; before it, then, none may stand before an option.
        """
        words = sys.argv[1:] if args is None else args
        is_plain = self._subparsers is not None or "--" in words  # which argparse loses among files before and after
        return super().parse_args(words, namespace) if is_plain else self.parse_intermixed_args(words, namespace)

    def parse_known_args(  # type: ignore[override]  # overloads of one meaning
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> tuple[Any, list[str]]:
        """Parse words as argparse does, and remember them for `error`."""
        self._words = sys.argv[1:] if args is None else list(args)
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Print the error in one line, with where to read about options, and exit with 2.

        A value that begins with a dash, which argparse takes for an option and therefore misses, is named.
        """
        if missed := re.fullmatch(r"argument (\S+): expected one argument", message):
            for option, value in itertools.pairwise(self._words):
                if self._are_option_and_value(missed[1].split("/"), option, value):
                    message = f"argument {missed[1]}: {value!r} begins with a dash; write {option}={value}"
        notice(f"{self.prog}: error: {message} (see {self.prog} --help)")
        self.exit(2)

    def _are_option_and_value(self, names: Sequence[str], option: str, value: str) -> bool:
        """Return whether a word is an option of one of these names, and the next one its value, beginning with a dash.

        Long names may be abbreviated.
        """

        def means(word: str, names: Iterable[str]) -> bool:
            return word in names or (word.startswith("--") and any(name.startswith(word) for name in names))

        known = self._option_string_actions
        return means(option, names) and len(value) > 1 and value[0] == "-" and not means(value.split("=")[0], known)


def add_version_option(parser: argparse.ArgumentParser) -> None:
    """Give a command's parser `--version`, which prints the version of KPC and exits."""
    parser.add_argument("--version", action="version", version=f"%(prog)s {VERSION}")


def print_json(value: Any) -> None:
    """Print a value as JSON, in ASCII characters and with valid Unicode in its strings, on stdout."""
    text = valid_unicode(json.dumps(value, ensure_ascii=False))
    print(json.dumps(json.loads(text), indent=1))


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an exception, its cause, the cause of that, and so on."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def print_error(name: str, message: str) -> None:
    """Print an error of a command as one line on stderr; line breaks, and what a terminal would obey, as escapes."""
    notice(f"{name}: {message}")


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`, and rename it to `path` on success or delete it on failure.

    A reader of `path` therefore never sees a half-written file. The temporary file keeps the suffix, since writers of
    images and videos choose the file format by it. As when a file is opened for writing, the target of a symbolic link
    is written and the link stays, and a file that is replaced passes its permissions on.

    Raises:
        OSError: the file cannot be written; the error names `path`.
    """
    target = Path(path)
    temporary: Path | None = None
    try:
        written, mode = file_written(target)
        beginning = target.stem[:60]  # so that a name may be as long as the system permits: four bytes for a letter
        with _naming_output("written", target):
            handle, name = tempfile.mkstemp(prefix=f".{beginning}.", suffix=target.suffix, dir=written.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        temporary.chmod(mode)  # mkstemp created it readable by its owner alone
        os.replace(temporary, written)
    except OSError as error:
        # Errors of writing name no file, all others the temporary one.
        is_of_target = temporary is None or error.filename == str(temporary)
        if is_of_target or (error.filename is None and error.errno in NO_ROOM):
            raise OSError(error.errno, error.strerror, str(target)) from error
        raise
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)  # unless it has been renamed


@contextlib.contextmanager
def _naming_output(done: str, path: Path) -> Iterator[None]:
    """Say of errors of the system, which may also be of a file that is read, that an output cannot be `done`."""
    try:
        yield
    except OSError as error:
        if error.errno in NO_ROOM:
            raise
        raise OSError(error.errno, f"cannot be {done} ({error.strerror}); give another name", str(path)) from error


def file_written(path: Path) -> tuple[Path, int]:
    """Return the file that is written under a name, and the permissions that it gets.

    It is the file of that name, there or not, or the target of a symbolic link. Folders, pipes and devices, which a
    file renamed to their name would replace, are refused; so are links to files with another suffix, which may be the
    very file that is read.

    Raises:
        OSError: it is none of these, or a link leads nowhere; the error names `path`.
    """
    written = Path(os.path.realpath(path)) if path.is_symlink() else path
    if written.suffix.lower() not in ("", path.suffix.lower()):
        reason = f"is a link to {escaped(written.name)}, a file of another kind; give another name"
        raise OSError(errno.EINVAL, reason, str(path))
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):  # of which the writer complains
        umask = os.umask(0)
        os.umask(umask)
        return written, 0o666 & ~umask
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, f"is a {_kind(mode)}; KPC writes files only, so give the name of one", str(path))
    return written, stat.S_IMODE(mode)


def _kind(mode: int) -> str:
    """Return what a name that is neither that of a file nor of a folder stands for."""
    return "named pipe" if stat.S_ISFIFO(mode) else "socket" if stat.S_ISSOCK(mode) else "device"


def check_writable(path: Path, *, is_folder: bool = False, option: str = "-o") -> None:
    """Check, before work that may take hours, that a file or a folder can be written.

    Args:
        path: of the file, whose folder must be there, or of a folder, which may be made with those above it.
        is_folder: which of both.
        option: which names it on the command line.

    Raises:
        UsageError: a folder is missing, is a file, or has the name of the file.
        OSError: nothing can be written there, or the file is write-protected; the error names `path`.
    """
    above = path.absolute()
    if not is_folder:
        if above.is_dir():
            raise UsageError(f"{path}: is a folder; give the name of a file")
        above = file_written(path)[0].absolute()
        if above.exists() and not os.access(above, os.W_OK):  # renaming would replace it all the same
            raise OSError(errno.EACCES, f"is write-protected; choose another name with {option}", str(path))
        above = above.parent
    while is_folder and not os.path.lexists(above) and above != above.parent:
        above = above.parent
    shown = next((one for one in (path, *path.parents) if one.absolute() == above), above)
    if above.exists() and not above.is_dir():
        raise UsageError(f"{shown}: is a file, not a folder; give another name")
    if above.is_symlink() and not above.exists():
        raise UsageError(f"{shown}: is a link that leads nowhere; give another name")
    if not above.is_dir():
        raise UsageError(f"{shown}: no such folder; make it first, or choose another place with {option}")
    if not os.access(above, os.W_OK):
        raise OSError(errno.EACCES, f"no permission to write there; choose another place with {option}", str(path))
    try:  # some file systems, such as /proc, grant what they do not do
        with tempfile.TemporaryFile(dir=above):
            pass
    except OSError as error:
        if error.errno in NO_ROOM:
            raise OSError(error.errno, error.strerror, str(path)) from error
        reason = f"nothing can be written there ({error.strerror}); choose another place with {option}"
        raise OSError(error.errno, reason, str(path)) from error


def refuse_sources(output: Path, *sources: Path, option: str = "-o") -> None:
    """Refuse an output that would replace a file that is read.

    Args:
        output: to be written.
        sources: files, or folders, which no file can replace.
        option: that names another output.

    Raises:
        UsageError: it is one of the sources, by whatever name.
    """
    if output.exists() and any(source.exists() and output.samefile(source) for source in sources):
        raise UsageError(f"{output}: is the source, too; write elsewhere with {option}")


def make_folder(path: Path) -> None:
    """Make a folder, and those above it, unless it is there.

    Raises:
        UsageError: a file has that name.
        OSError: it cannot be made; the error names `path`.
    """
    with _naming_output("made", path):
        if path.exists() and not path.is_dir():
            raise UsageError(f"{path}: is a file, not a folder; give another name")
        path.mkdir(parents=True, exist_ok=True)


def input_path(text: str) -> Path:
    """Parse the path of a file or folder to read; refuse addresses, which as paths would lose a slash."""
    if _ADDRESS.match(text):
        raise argparse.ArgumentTypeError("an address cannot be given here; download the file and give its path")
    return named_path(text)


def output_name(text: str) -> str:
    """Return the name of a file or folder to write; refuse addresses, for which folders would be made here."""
    if _ADDRESS.match(text):
        raise argparse.ArgumentTypeError("nothing is written to an address; give a file or folder of this machine")
    return file_name(text)


def output_path(text: str) -> Path:
    """Parse the path of a file or folder to write, as `output_name`."""
    return Path(output_name(text))


def file_name(text: str) -> str:
    """Return a path or an address unchanged; refuse an empty one, which as a path is the working directory, and "-"."""
    if not text:
        raise argparse.ArgumentTypeError("the name is empty")
    if text == "-":
        raise argparse.ArgumentTypeError("'-' is no file; files are neither read from stdin nor written to stdout")
    return text


def named_path(text: str) -> Path:
    """Parse the path of a file or folder, which is not empty."""
    return Path(file_name(text))


def output_file(*suffixes: str) -> Callable[[str], Path]:
    """Return a parser of names of files to write that end in one of these suffixes, in capital letters or not.

    Writers choose the kind of a file by its suffix, so any other name would promise what is not written.
    """

    def parse(text: str) -> Path:
        path = output_path(text)
        if text.endswith(tuple(filter(None, (os.sep, os.altsep)))) or path.suffix.lower() not in suffixes:
            raise argparse.ArgumentTypeError(f"{text!r} does not end in {' or '.join(suffixes)}")
        return path

    return parse


def duration_s(text: str) -> float:
    """Parse a duration such as "90", "90s", "10m" or "1.5h" into seconds."""
    unit = {"s": 1, "m": 60, "h": 3600}.get(text[-1:], None)
    try:
        value = float(text[:-1]) * unit if unit else float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text!r} is not a duration; write for example 90s, 10m or 1.5h")
    return value


def time_s(text: str) -> float:
    """Parse a time of a clip such as "1.5", "1.5s" or "2m" into seconds; 0 is one."""
    return 0.0 if text in ("0", "0s", "0.0") else duration_s(text)


def frame_rate(low: float, high: float) -> Callable[[str], float]:
    """Return a parser of frame rates from `low` to `high` frames per second, fractions such as "24000/1001", too."""

    def parse(text: str) -> float:
        above, slash, below = text.partition("/")
        if slash and above.isdecimal() and below.isdecimal() and float(below) > 0:
            text = repr(float(above) / float(below))
        return number_within(text, low, high, "a frame rate")

    return parse


def number_within(text: str, low: float, high: float, name: str = "a number") -> float:
    """Parse a number from `low` to `high`; the error calls it `name`."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"{text!r} is not {name} from {low:g} to {high:g}")
    return value


def whole_number(text: str, low: int = 0, high: int | None = None) -> int:
    """Parse a whole number from `low` to `high`, if there is a largest."""
    most, end = (math.inf, "on") if high is None else (high, f"to {high}")
    if not (text.isascii() and text.isdecimal()) or len(text) > 20 or not low <= int(text) <= most:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {low} {end}")
    return int(text)


def decibels(text: str) -> float:
    """Parse a quality loss such as "0.1" or "0.1dB" into decibels."""
    return _decibels(text, "a loss of quality; write for example 0.1dB")


def psnr_db(text: str) -> float:
    """Parse a PSNR such as "33" or "33dB" into decibels."""
    return _decibels(text, "a PSNR; write for example 33dB")


def _decibels(text: str, what: str) -> float:
    try:
        value = float(text.lower().removesuffix("db"))
    except ValueError:
        value = math.nan
    if not 0 < value < 100:
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return value


def byte_count(text: str) -> int:
    """Parse a size such as "300000", "300KB" (1 KB = 1,000 bytes), "2MB" or "1.5GB" into bytes."""
    number = text.upper().removesuffix("B")
    unit = {"K": 10**3, "M": 10**6, "G": 10**9}.get(number[-1:], 1)
    try:
        value = float(number[:-1] if unit > 1 else number) * unit
    except ValueError:
        value = math.nan
    if not 1 <= value < 1e12:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size; write for example 300KB or 2MB")
    return int(value)


def join_values(argv: list[str], *options: str) -> list[str]:
    """Turn `--box -1,...` into `--box=-1,...`, since argparse takes a value that starts with a minus for an option."""
    joined: list[str] = []
    for word in argv:
        if joined and joined[-1] in options:
            joined[-1] = f"{joined[-1]}={word}"
        else:
            joined.append(word)
    return joined


def box_corners(text: str) -> tuple[float, ...]:
    """Parse the corners of a box, "x0,y0,z0,x1,y1,z1", into six numbers."""
    try:
        numbers = tuple(float(n) for n in text.split(","))
    except ValueError:
        numbers = ()
    is_finite = len(numbers) == 6 and all(map(math.isfinite, numbers))
    if not is_finite or not all(low < high for low, high in zip(numbers[:3], numbers[3:], strict=True)):
        raise argparse.ArgumentTypeError(f"{text!r} is not x0,y0,z0,x1,y1,z1 with each lower bound below the upper")
    return numbers
