"""The encoder: from posed pictures to a .kpc file. It needs PyTorch, PyAV and numba (the extra
`kpc[encoder]`).
"""

import sys

from kpc.format.common.text import notice
from kpc.format.common.version import VERSION


def main(argv: list[str] | None = None) -> int:
    """Run `kpenc`; where only the viewer is installed, print how to install the encoder and return 1."""
    arguments = sys.argv[1:] if argv is None else argv
    if "--version" in arguments:  # known without the encoder, too
        print(f"kpenc {VERSION}")
        return 0
    try:
        from kpc.encoder.cli import kpenc
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "av", "numba"):
            raise
        remedy = 'in a checkout of KPC, pip install ".[encoder]"'
        notice(f"kpenc: needs {error.name}, which is not installed; {remedy}")
        return 1
    return kpenc.main(argv)
