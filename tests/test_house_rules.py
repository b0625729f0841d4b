"""The rules that keep the code readable.

* A file has at most 500 lines (a test file 800), a function outside the tests at most 80 lines without its docstring,
  and at most ten parameters without `self` and `cls`. An exception gives its reason in the docstring of the module or
  function, with "because" or "since": a long module says why it is "one module", a long function why it is
  "one function", and one with many parameters why its "parameters" are so many.
* A docstring is a sentence; it does not begin with "Of".
* Constants and attributes are documented by comments, not by string literals.
* What users' commands say on stderr goes through `notice`, which escapes what names of files may hold.
* The repository contains no symbolic links, since a clone on Windows turns them into text files.
"""

import ast
import shutil
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

FILE_LINES, TEST_FILE_LINES, FUNCTION_LINES, PARAMETERS = 500, 800, 80, 10

Function = ast.FunctionDef | ast.AsyncFunctionDef
Documented = ast.Module | ast.ClassDef | Function


def tracked(*arguments: str) -> list[str]:
    """Return the lines that `git ls-files` prints; skip the test where there is no git checkout."""
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("no git checkout")
    done = subprocess.run(["git", "-C", str(ROOT), "ls-files", *arguments], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


@cache
def sources() -> dict[str, tuple[str, ast.Module]]:
    """Return text and syntax tree of each tracked Python file, by its path relative to the root."""
    found = {}
    for name in tracked("*.py"):
        if (ROOT / name).exists() and not name.startswith("spec/vectors/"):
            text = (ROOT / name).read_text()
            found[name] = text, ast.parse(text, name)
    return found


def nodes(*kinds: type[ast.AST]) -> Iterator[tuple[str, ast.AST]]:
    """Yield path and node of all nodes of the given kinds in all files."""
    for name, (_, tree) in sources().items():
        for node in ast.walk(tree):
            if isinstance(node, kinds):
                yield name, node


def functions() -> Iterator[tuple[str, Function]]:
    """Yield place and node of all functions outside the tests."""
    for name, node in nodes(ast.FunctionDef, ast.AsyncFunctionDef):
        if not name.startswith("tests/"):
            assert isinstance(node, Function)
            yield f"{name}:{node.lineno} {node.name}", node


def explains(node: Documented, what: str) -> bool:
    """Return whether the docstring of a node gives a reason for `what`."""
    docstring = " ".join((ast.get_docstring(node) or "").lower().split())
    return what in docstring and any(word in docstring for word in ("because", "since"))


def line_count(function: Function) -> int:
    """Return the number of lines of a function without decorators and docstring."""
    count = (function.end_lineno or function.lineno) - function.lineno + 1
    if ast.get_docstring(function) is not None:
        docstring = function.body[0]
        count -= (docstring.end_lineno or docstring.lineno) - docstring.lineno + 1
    return count


def parameter_count(function: Function) -> int:
    """Return the number of parameters, where `*args` and `**kwargs` count once each."""
    given = function.args
    named = [*given.posonlyargs, *given.args, *given.kwonlyargs]
    return sum(one.arg not in ("self", "cls") for one in named) + (given.vararg is not None) + (given.kwarg is not None)


def test_files_are_short() -> None:
    long = {}
    for name, (text, tree) in sources().items():
        limit = TEST_FILE_LINES if name.startswith("tests/") else FILE_LINES
        if (count := text.count("\n")) > limit and not explains(tree, "one module"):
            long[name] = count
    assert not long


def test_functions_are_short() -> None:
    long = {
        place: count
        for place, node in functions()
        if (count := line_count(node)) > FUNCTION_LINES and not explains(node, "one function")
    }
    assert not long


def test_functions_have_few_parameters() -> None:
    many = {
        place: count
        for place, node in functions()
        if (count := parameter_count(node)) > PARAMETERS and not explains(node, "parameters")
    }
    assert not many


def test_docstrings_are_sentences() -> None:
    fragments = [
        f"{name}:{getattr(node, 'lineno', 1)}"
        for name, node in nodes(ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
        if isinstance(node, Documented) and (ast.get_docstring(node) or "").split()[:1] == ["Of"]
    ]
    assert not fragments


def test_constants_are_documented_by_comments() -> None:
    literals = []
    for name, node in nodes(ast.Module, ast.ClassDef):
        assert isinstance(node, ast.Module | ast.ClassDef)
        literals += [
            f"{name}:{statement.lineno}"
            for statement in node.body[1:]
            if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
            if isinstance(statement.value.value, str)
        ]
    assert not literals


def test_messages_are_escaped() -> None:
    apart = ("tests/", "spec/", ".ci/", "tools/bench/", "tools/dev/", "tools/vectors/", "encoder/training/")
    found = [
        f"{name}:{node.lineno}"
        for name, node in nodes(ast.Call)
        if not name.startswith(apart) and isinstance(node, ast.Call) and ast.unparse(node.func) == "print"
        if any(ast.unparse(keyword.value) == "sys.stderr" for keyword in node.keywords)
        and any(isinstance(part, ast.JoinedStr) for part in node.args)
    ]
    assert not found, f"print these by kpc.format.common.text.notice: {found}"


def test_there_are_no_symbolic_links() -> None:
    assert [line for line in tracked("--stage") if line.startswith("120000")] == []
