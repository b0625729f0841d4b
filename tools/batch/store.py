"""The place that all workers of a batch share: a folder, or what an address names, through fsspec.

KEY/scene.kpc      the result of a task, and
KEY/result.json    its figures, written last: a task is done if this exists
KEY/work/          checkpoints and the like, from which another worker goes on
KEY/log.txt        what kpenc printed
"""

import contextlib
import json
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from kpc.format.common import cli
from kpc.format.common.errors import KpcError

RESULT, LOG, SCENE, WORK = "result.json", "log.txt", "scene.kpc", "work"


class StoreError(KpcError):
    """The shared place cannot be read or written."""


def reason(error: Exception) -> str:
    """Return in a line why a file system of fsspec failed: many raise errors of their own, not only OSError."""
    said = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(said.split()) or type(error).__name__


class Store:
    """Files below a folder or an address. What is written appears whole or not at all."""

    def __init__(self, address: str, *, make: bool = True) -> None:
        """Open the place, and make it if it is a folder and `make` is true; nothing is in a folder that is not there.

        Raises:
            StoreError: the address is of an unknown kind, or the folder cannot be made.
        """
        import fsspec  # here, since kpbatch has a help without it

        self.address = address
        try:
            self._fs, self._root = fsspec.core.url_to_fs(address)
            self._is_local = "file" in self._fs.protocol
            if make:
                self._fs.makedirs(self._root, exist_ok=True)
        except Exception as error:
            raise StoreError(f"{address}: {reason(error)}") from error

    def exists(self, name: str) -> bool:
        with self._errors(name):
            self._fs.invalidate_cache()
            return bool(self._fs.exists(self._path(name)))

    def names(self, pattern: str) -> list[str]:
        """Return the names that match a pattern such as "*/result.json"."""
        with self._errors(pattern):
            self._fs.invalidate_cache()
            prefix = self._fs._strip_protocol(self._root).rstrip("/") + "/"
            return sorted(found.removeprefix(prefix) for found in self._fs.glob(self._path(pattern)))

    def put(self, file: Path, name: str) -> None:
        """Copy a local file there, under another name first."""
        with self._written(name) as temporary, self._errors(name):
            self._fs.put_file(str(file), temporary)

    def put_json(self, value: Any, name: str) -> None:
        self.put_text(json.dumps(value, indent=1), name)

    def put_text(self, text: str, name: str) -> None:
        with self._written(name) as temporary, self._errors(name):
            self._fs.pipe_file(temporary, text.encode())

    def get(self, name: str, file: Path) -> None:
        """Copy what is there to a local file, under another name first."""
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary = file.with_name(f".{file.name}.{uuid.uuid4().hex}")
        try:
            with self._errors(name):
                self._fs.get_file(self._path(name), str(temporary))
            temporary.replace(file)
        finally:
            temporary.unlink(missing_ok=True)

    def get_text(self, name: str) -> str:
        """Return what a text in UTF-8 holds.

        Raises:
            StoreError: it is missing.
        """
        with self._errors(name):
            self._fs.invalidate_cache()
            return bytes(self._fs.cat_file(self._path(name))).decode(errors="replace")

    def get_json(self, name: str) -> Any:
        """Return what a JSON file holds.

        Raises:
            StoreError: it is missing or damaged.
        """
        try:
            return json.loads(self.get_text(name))
        except ValueError as error:
            raise StoreError(f"{self.address}/{name}: is damaged; delete it to have it made anew") from error

    def get_folder(self, name: str, folder: Path) -> bool:
        """Copy all files below a name to a local folder; return whether there were any."""
        found = [each for each in self.names(f"{name}/**") if self._is_file(each)]
        for each in found:
            self.get(each, folder / each.removeprefix(f"{name}/"))
        return bool(found)

    def copy(self, name: str, other: str) -> None:
        """Copy a file there to another name."""
        with self._written(other) as temporary, self._errors(name):
            self._fs.copy(self._path(name), temporary)

    def remove(self, name: str) -> None:
        """Remove a file or a folder, if it is there."""
        with self._errors(name), contextlib.suppress(FileNotFoundError):
            self._fs.rm(self._path(name), recursive=True)

    def _path(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}"

    def _is_file(self, name: str) -> bool:
        with self._errors(name):
            return bool(self._fs.isfile(self._path(name)))

    @contextlib.contextmanager
    def _written(self, name: str) -> Iterator[str]:
        """Yield a path to write to; it is renamed to `name` on success, and removed otherwise."""
        target = self._path(name)
        if self._is_local:
            with self._errors(name):
                target = str(cli.file_written(Path(target))[0])
        folder, _, last = target.rpartition("/")
        temporary = f"{folder}/.{uuid.uuid4().hex}.{last}"
        try:
            with self._errors(name):
                self._fs.makedirs(folder, exist_ok=True)
            yield temporary
            with self._errors(name):
                self._rename(temporary, target)
        except BaseException:
            with contextlib.suppress(Exception):
                self._fs.rm(temporary)
            raise

    def _rename(self, temporary: str, target: str) -> None:
        if self._is_local:
            shutil.move(temporary, target)  # os.replace; fsspec's own would copy
        else:
            self._fs.mv(temporary, target)

    @contextlib.contextmanager
    def _errors(self, name: str) -> Iterator[None]:
        try:
            yield
        except FileNotFoundError:
            raise StoreError(f"{self.address}/{name}: no such file") from None
        except Exception as error:
            raise StoreError(f"{self.address}/{name}: {reason(error)}") from error
