"""Where keys stand in a TOML file: Python's parser does not say."""

import re
from pathlib import Path

HEADER = re.compile(r"\s*\[\[?\s*([\w.-]+)\s*\]\]?")
KEY = re.compile(r"""\s*["']?([\w-]+)["']?\s*(?:\.[\w."'-]+\s*)?=""")


class TomlLines:
    """Lines of the keys of tables and arrays of tables; what cannot be found stands at the table, or in line 1."""

    def __init__(self, path: Path, text: str) -> None:
        self._path = path
        # Lines of keys outside arrays of tables, and for each [[scene]], its line and those of its keys.
        self._keys: dict[str, int] = {}
        self._scenes: list[tuple[int, dict[str, int]]] = []
        is_scene = False
        for number, line in enumerate(text.splitlines(), 1):
            if header := HEADER.match(line):
                is_scene = header[1].split(".")[0] == "scene"
                if line.lstrip().startswith("[[") and is_scene:
                    self._scenes.append((number, {}))
                self._keys.setdefault(header[1].split(".")[0], number)
                continue
            keys = self._scenes[-1][1] if is_scene and self._scenes else self._keys
            for key in KEY.findall(line) + re.findall(r"[{,]\s*([\w-]+)\s*=", line):
                keys.setdefault(key, number)

    def of(self, key: str, scene: int | None = None) -> str:
        """Return "FILE:LINE" of a key: of the scene of that number if it has it, else of a table before."""
        line = self._keys.get(key, 1)
        if scene is not None and scene < len(self._scenes):
            start, keys = self._scenes[scene]
            line = start if key == "scene" else keys.get(key, self._keys.get(key, start))
        return f"{self._path}:{line}"
