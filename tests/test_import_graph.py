"""No module of kpc imports itself through others, and the folders of the player import each other in one direction.

Imports inside functions count like those at the top of a module: they would only hide a cycle. Importing a package
implicitly, as `import kpc.encoder.coding.rans` does with `kpc.format`, does not count.
"""

import ast
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("encoder", "format", "player", "tools")

# Folders of the player from the lowest to the highest: each may import the ones before it.
PLAYER_LAYERS = ("kpc.player.cpu", "kpc.player.gl", "kpc.player.streaming", "kpc.player.app")


@cache
def modules() -> dict[str, Path]:
    """Return the file of each module of kpc by its name."""
    found = {"kpc": ROOT / "src" / "kpc" / "__init__.py", "kpc.jit": ROOT / "src" / "kpc" / "jit.py"}
    for package in PACKAGES:
        for file in sorted((ROOT / package).rglob("*.py")):
            parts = file.relative_to(ROOT).with_suffix("").parts
            found[".".join(("kpc", *parts)).removesuffix(".__init__")] = file
    return found


@cache
def import_graph() -> dict[str, frozenset[str]]:
    """Return the modules of kpc that each one imports, anywhere in its text."""
    return {name: frozenset(imported(file) - {name}) for name, file in modules().items()}


def imported(file: Path) -> set[str]:
    """Return the modules of kpc that a file names in import statements."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(), str(file))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                submodule = f"{node.module}.{alias.name}"
                found.add(submodule if submodule in modules() else node.module)
    return found & set(modules())


def cycles(graph: dict[str, frozenset[str]]) -> list[list[str]]:
    """Return the strongly connected components of more than one node (Tarjan, SIAM J. Comput. 1, 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in sorted(graph[node]):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            component = [stack.pop()]
            while component[-1] != node:
                component.append(stack.pop())
            if len(component) > 1:
                found.append(sorted(component))

    for node in graph:
        if node not in index:
            visit(node)
    return found


def test_the_graph_is_complete() -> None:
    graph = import_graph()
    assert len(graph) > 100 and "kpc.format.scene.scene" in graph["kpc.format.container.scene_reader"]
    assert any("kpc.encoder" in name for name in graph["kpc.tools.bench.harness"])  # an import inside a function


def test_cycles_are_found() -> None:
    graph = {"a": frozenset("b"), "b": frozenset("c"), "c": frozenset("b"), "d": frozenset("ad")}
    assert cycles(graph) == [["b", "c"]]


def test_no_module_imports_itself_through_others() -> None:
    assert cycles(import_graph()) == []


@pytest.mark.parametrize("layer", PLAYER_LAYERS)
def test_the_player_is_layered(layer: str) -> None:
    higher = tuple(f"{other}." for other in PLAYER_LAYERS[PLAYER_LAYERS.index(layer) + 1 :])
    wrong = [
        f"{name} imports {other}"
        for name, others in import_graph().items()
        if name.startswith(f"{layer}.")
        for other in sorted(others)
        if other.startswith(higher)
    ]
    assert not wrong
