"""The packages that only extras of KPC bring, and how they are installed."""

# The packages that modules of KPC import, by the extra that brings them; the smaller of two extras comes first.
PACKAGES = {
    "cpu": ("numba", "llvmlite"),
    "film": ("imageio_ffmpeg", "OpenEXR"),
    "sound": ("miniaudio", "soundfile"),
    "poses": ("pycolmap", "scipy"),
    "cluster": ("dask", "distributed", "fsspec", "jinja2", "psutil"),
    "exchange": ("pxr", "skimage"),
    "bench": ("flip_evaluator", "jinja2", "matplotlib", "scipy", "zstandard"),
    "encoder": ("OpenEXR", "av", "imageio_ffmpeg", "llvmlite", "lz4", "numba", "torch", "yaml"),
}

# The extras that a command needs anyway, where several bring a package.
NEEDED = {"kpenc": ("encoder",), "kpposes": ("encoder",), "kpbench": ("bench", "encoder")}

# What is said of packages of an extra that do not speak for themselves.
SAID = {"poses": "finding cameras needs COLMAP"}


def install(extra: str) -> str:
    """Return the shell command that adds an extra to the KPC that is installed."""
    return f'pip install "kpc[{extra}]"'


def remedy(missing: str | None, command: str) -> str | None:
    """Return what to do about a module that Python did not find; None where no extra brings it.

    Args:
        missing: the name of the module.
        command: the name of the program that needs it.
    """
    package = (missing or "").partition(".")[0]
    for extra in (*NEEDED.get(command, ()), *PACKAGES):
        if package in PACKAGES[extra]:
            return f"{SAID.get(extra, f'needs {package}, which is not installed')}; {install(extra)}"
    return None
