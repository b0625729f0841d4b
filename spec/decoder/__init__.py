"""A .kpc decoder in plain Python, written from kpc-format.md alone: slow, short, and independent of the kpc package.

    python -m decoder scene.kpc        (in the folder spec) prints what the file holds and the SHA-256 of every plane

Each module names the section of the page that it follows, and uses the names that its formulas use. Only Zstandard
comes from a library.
"""

from .common import Refused
from .groups import blend, decode_groups, shown_group
from .render import render_ray
from .scene import decode, hashes

__all__ = ["Refused", "blend", "decode", "decode_groups", "hashes", "render_ray", "shown_group"]
