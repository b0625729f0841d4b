"""The encoder: from posed pictures to a .kpc file. Needs PyTorch (the extra `kpc[encoder]`), which viewers do not."""

import sys


def main(argv: list[str] | None = None) -> int:
    """Run `kpenc`; where only the viewer is installed, print how to install the encoder and return 1."""
    try:
        from kpc.encoder.cli import kpenc
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        print(f'kpenc: needs {error.name}, which is not installed; pip install "kpc[encoder]"', file=sys.stderr)
        return 1
    return kpenc.main(argv)
