"""Programs in which packages are missing that are installed here."""


def without(*packages: str) -> str:
    """The beginning of a program that finds none of these."""
    return f"""
import sys
class Nowhere:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {packages}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Nowhere())
"""
