"""Ctrl-C in processes of their own: while modules load, while a command runs, and while kernels compile."""

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

# What is loaded as the module of a command, and interrupts itself.
SIGNAL = "import os, signal\n\ndef press():\n    os.kill(os.getpid(), signal.SIGINT)\n"


def interrupted(folder: Path, command: str) -> subprocess.CompletedProcess[str]:
    """Run the module `command` by the way of entry points, with Ctrl-C heeded."""
    (folder / "keyboard.py").write_text(SIGNAL)
    (folder / "command.py").write_text(textwrap.dedent(command))
    program = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from kpc.commands import _run; sys.path.insert(0, sys.argv.pop()); sys.exit(_run('kpx', 'command'))"
    )
    return subprocess.run([sys.executable, "-c", program, str(folder)], capture_output=True, text=True, timeout=120)


def test_the_first_import_ends_quietly() -> None:
    """Ctrl-C raises KeyboardInterrupt there, since nothing handles it yet."""
    program = """
        import sys
        class Keyboard:
            def find_spec(self, name, *_):
                if name == "kpc.format.common.interrupts":
                    raise KeyboardInterrupt
        sys.meta_path.insert(0, Keyboard())
        sys.argv = ["/usr/bin/kpx"]
        import kpc.commands
    """
    ended = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "kpx: interrupted\n")


@pytest.mark.parametrize(
    "command",
    [
        pytest.param("import keyboard\nkeyboard.press()\nmain = print", id="loading"),
        pytest.param(
            """
            import keyboard
            from kpc.format.common import cli
            def main(argv):
                return cli.run(lambda _: keyboard.press(), "kpx")
            """,
            id="running",
        ),
        pytest.param(
            """
            import time
            import keyboard
            from kpc.format.common import cli
            def endless(_):
                while True:  # loses what is raised, as callbacks of C do
                    try:
                        keyboard.press()
                        time.sleep(60)
                    except KeyboardInterrupt:
                        pass
            def main(argv):
                return cli.run(endless, "kpx")
            """,
            id="a second one",
        ),
        pytest.param(
            """
            import keyboard
            from numba import extending, njit, types
            from kpc import jit
            from kpc.format.common import cli
            def marker():
                pass
            @extending.overload(marker)
            def _():
                keyboard.press()  # deferred
                return lambda: None
            def main(argv):
                return cli.run(lambda _: njit(lambda: marker())(), "kpx")
            """,
            id="compiling",
        ),
    ],
)
def test_ctrl_c_ends_in_one_line(tmp_path: Path, command: str) -> None:
    done = interrupted(tmp_path, command)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "kpx: interrupted\n")


def test_a_handler_of_the_command_takes_as_long_as_it_needs(tmp_path: Path) -> None:
    """As in training, which saves a checkpoint after Ctrl-C and asks whether to go on."""
    command = """
    import signal, time
    import keyboard
    from kpc.format.common import cli, interrupts
    interrupts.LONGEST_S = 0.2
    def patient(_):
        before = signal.signal(signal.SIGINT, lambda *_: interrupts.heard())
        keyboard.press()
        signal.signal(signal.SIGINT, before)
        time.sleep(0.7)
        print("went on")
    def main(argv):
        return cli.run(patient, "kpx")
    """
    done = interrupted(tmp_path, command)
    assert (done.returncode, done.stdout, done.stderr) == (0, "went on\n", "")


def test_sigterm_ends_as_ctrl_c_does_even_where_that_is_ignored(tmp_path: Path) -> None:
    command = """
    import os, signal
    from kpc.format.common import cli
    def write(_):
        with cli.atomic_write("film.mp4"):
            os.kill(os.getpid(), signal.SIGTERM)
            signal.pause()
    def main(argv):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        os.chdir(os.path.dirname(__file__))
        return cli.run(write, "kpx")
    """
    done = interrupted(tmp_path, command)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "kpx: interrupted\n")
    assert not [path for path in tmp_path.iterdir() if path.suffix == ".mp4"]


def test_what_is_lost_ends_in_time(tmp_path: Path) -> None:
    command = """
    import time
    import keyboard
    from kpc.format.common import cli, interrupts
    interrupts.LONGEST_S = 0.2
    def deaf(_):
        try:
            keyboard.press()
            time.sleep(60)
        except KeyboardInterrupt:
            time.sleep(60)
    def main(argv):
        return cli.run(deaf, "kpx")
    """
    done = interrupted(tmp_path, command)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "kpx: interrupted\n")


def test_a_command_that_is_not_interrupted_returns_its_code(tmp_path: Path) -> None:
    done = interrupted(tmp_path, "def main(argv):\n    return 3")
    assert (done.returncode, done.stdout, done.stderr) == (3, "", "")
