"""The layers of the packages: format below encoder and player, tools above; encoder and player are independent."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

# The packages that no module of a folder may import.
FORBIDDEN = {
    "format": {
        "kpc.encoder",
        "kpc.player",
        "kpc.tools",
        "torch",
        "moderngl",
        "glfw",
        "slimgui",
        "OpenGL",
        "numba",
        "llvmlite",
        "kpc.jit",
    },
    "encoder": {"kpc.player", "kpc.tools", "moderngl", "glfw", "slimgui", "OpenGL"},
    "player": {"kpc.encoder", "kpc.tools", "torch"},
    "tools": set(),
}


def imports(file: Path) -> set[str]:
    """Return the full names of all modules that a file imports, at its top or inside functions."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(), str(file))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            found |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def is_within(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


@pytest.mark.parametrize("package", FORBIDDEN)
def test_layers_hold(package: str) -> None:
    files = sorted((ROOT / package).rglob("*.py"))
    assert files
    for file in files:
        for module in imports(file):
            broken = [other for other in FORBIDDEN[package] if is_within(module, other)]
            assert not broken, f"{file.relative_to(ROOT)} imports {module}"


def test_the_package_itself_needs_no_torch() -> None:
    assert not any(is_within(m, p) for m in imports(ROOT / "src/kpc/__init__.py") for p in ("torch", "kpc.encoder"))
