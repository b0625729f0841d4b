"""From a dataset to a scene. Needs PyTorch, the extra `kpc[encoder]`, which viewers do without."""

import sys


def main(argv: list[str] | None = None) -> int:
    """`kpenc`, or one line on how to get it where only the viewer is installed."""
    try:
        from kpc.encoder.cli import kpenc
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        print(f'kpenc: needs {error.name}, which is not installed; pip install "kpc[encoder]"', file=sys.stderr)
        return 1
    return kpenc.main(argv)
