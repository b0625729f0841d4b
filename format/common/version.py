"""The version of KPC."""

from importlib import metadata

try:
    VERSION = metadata.version("kpc")
except metadata.PackageNotFoundError:  # run from a source tree that is not installed
    VERSION = "0+unknown"
