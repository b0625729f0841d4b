"""Print what a .kpc file holds."""

import sys

from . import Refused, decode, decode_groups, hashes


def main(path):
    with open(path, "rb") as file:
        data = file.read()
    grouped = decode_groups(data)
    for scene in [decode(data)] if grouped is None else grouped[1]:
        print({key: scene[key] for key in ("aabb", "frame_count", "fps", "ray_step", "background", "cells")})
        for (number, name), (symbols, _, _) in hashes(scene).items():
            print(f"scale {number} {name}: symbols {symbols}")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m decoder FILE.kpc")
    try:
        main(sys.argv[1])
    except (Refused, OSError) as error:
        sys.exit(f"{sys.argv[1]}: {error}")
