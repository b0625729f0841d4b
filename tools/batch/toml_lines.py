"""Where keys stand in a TOML file: Python's parser does not say."""

import re
from pathlib import Path

HEADER = re.compile(r"\s*\[\[?\s*([\w.-]+)\s*\]\]?")
# A key, and the last part of one that has dots.
KEY = re.compile(r"""\s*["']?([\w-]+)["']?\s*(?:\.\s*["']?([\w-]+)["']?\s*)*=""")


class TomlLines:
    """Lines of the keys of tables and arrays of tables; what cannot be found stands at the table, or in line 1."""

    def __init__(self, path: Path, text: str) -> None:
        self._path = path
        # Lines of keys of each table outside arrays of tables, "" without one; those of headers are there, too. And for
        # each [[scene]], its line and those of its keys.
        self._tables: dict[str, dict[str, int]] = {"": {}}
        self._scenes: list[tuple[int, dict[str, int]]] = []
        table = ""
        for number, line in enumerate(text.splitlines(), 1):
            if header := HEADER.match(line):
                table = header[1].split(".")[0]
                if line.lstrip().startswith("[[") and table == "scene":
                    self._scenes.append((number, {}))
                self._tables[""].setdefault(table, number)
                continue
            own = self._tables.setdefault(table, {})
            keys = self._scenes[-1][1] if table == "scene" and self._scenes else own
            parts = found.groups("") if (found := KEY.match(line)) else ()
            for key in (*filter(None, parts), *re.findall(r"[{,]\s*([\w-]+)\s*=", line)):
                keys.setdefault(key, number)

    def of(self, key: str, scene: int | None = None, tables: tuple[str, ...] = ("",)) -> str:
        """Return "FILE:LINE" of a key.

        Args:
            key: its name, or that of a table.
            scene: the number of a [[scene]]; its own keys come first.
            tables: where else the key may stand, the first of them that has it; "" is outside of tables, where a table
                in braces has its keys, too.
        """
        places = [self._tables.get(table, {}) for table in (*tables, "")]
        line = 1
        if scene is not None and scene < len(self._scenes):
            line, own = self._scenes[scene]
            places = [] if key == "scene" else [own, *places]
        return f"{self._path}:{next((keys[key] for keys in places if key in keys), line)}"
