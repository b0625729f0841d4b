"""The origin of a measurement: code, machine, software and data."""

import hashlib
import importlib.metadata
import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import kpc

# Bytes hashed at a time.
BLOCK = 1 << 20


def commit() -> str:
    """Return the git commit of the checkout that `kpc` was imported from.

    It ends with "+dirty" if tracked files have changed since, and is "unknown" without a checkout.
    """
    source = Path(kpc.__file__).resolve()
    # An installed copy may lie in a folder of another checkout, which then does not track it.
    tracked = _git(source.parent, "ls-files", "--error-unmatch", source.name)
    head = _git(source.parent, "rev-parse", "HEAD") if tracked else None
    if not head:
        return "unknown"
    return head + ("+dirty" if _git(source.parent, "status", "--porcelain", "--untracked-files=no", ":/") else "")


def machine() -> dict[str, str | int]:
    """Return processor, cores available to this process, memory in bytes, operating system and Python version."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return {
        "cpu": _cpu(),
        "cores": cores,
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "os": platform.platform(),
        "python": platform.python_version(),
    }


def versions() -> dict[str, str]:
    """Return the installed versions of kpc and its dependencies, including those of its extras."""
    wanted = [re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in importlib.metadata.requires("kpc") or ()]
    found = {}
    for name in ["kpc", *sorted(wanted, key=str.lower)]:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue  # part of an extra that is not installed
    return found


def data_hash(path: Path) -> str:
    """Return the SHA-256 of a file or folder as hexadecimal digits.

    For a folder, the hash covers its files in the order of their relative names, each as name (UTF-8), NUL, length (8
    bytes, little endian) and content. Hidden files and folders are ignored.
    """
    digest = hashlib.sha256()
    if path.is_file():
        _feed(digest, path)
        return digest.hexdigest()
    names = sorted(file.relative_to(path).as_posix() for file in path.rglob("*") if file.is_file())
    for name in names:
        if any(part.startswith(".") for part in name.split("/")):
            continue
        digest.update(name.encode() + b"\0" + (path / name).stat().st_size.to_bytes(8, "little"))
        _feed(digest, path / name)
    return digest.hexdigest()


def _feed(digest: "hashlib._Hash", path: Path) -> None:
    with path.open("rb") as file:
        while block := file.read(BLOCK):
            digest.update(block)


def _git(folder: Path, *arguments: str) -> str | None:
    """Return the output of git, or None if it fails or is not installed."""
    try:
        done = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=False)
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _cpu() -> str:
    """Return the name of the processor."""
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    if found:
        return found[1].strip()
    if sys.platform == "darwin":
        done = subprocess.run(["sysctl", "-n", "machdep.cpu.brand_string"], capture_output=True, text=True, check=False)
        return done.stdout.strip() or platform.machine()
    return platform.processor() or platform.machine()
