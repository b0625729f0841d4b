"""Who may import whom: format <- encoder, player <- tools; encoder and player never each other."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FORBIDDEN = {
    "format": {
        "kpc.encoder",
        "kpc.player",
        "kpc.tools",
        "torch",
        "moderngl",
        "glfw",
        "imgui_bundle",
        "OpenGL",
    },
    "encoder": {"kpc.player", "kpc.tools", "moderngl", "glfw", "imgui_bundle", "OpenGL"},
    "player": {"kpc.encoder", "kpc.tools", "torch"},
    "tools": set(),
}
VIEWERS = ("format", "player")
"""What a viewer installs must import without the extras."""


def imports(file: Path) -> set[str]:
    """Every module a file imports, wherever in it, by its full name."""
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


@pytest.mark.parametrize("floor", FORBIDDEN)
def test_floors_hold(floor: str) -> None:
    files = sorted((ROOT / floor).rglob("*.py"))
    assert files
    for file in files:
        for module in imports(file):
            broken = [package for package in FORBIDDEN[floor] if is_within(module, package)]
            assert not broken, f"{file.relative_to(ROOT)} imports {module}"


def test_the_package_itself_needs_no_torch() -> None:
    assert not any(is_within(m, p) for m in imports(ROOT / "src/kpc/__init__.py") for p in ("torch", "kpc.encoder"))
