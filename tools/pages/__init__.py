"""Pages that the tools write: templates of Jinja2, in which whatever is filled in is escaped.

A page is one file that asks for no other: its policy permits styles and pictures that it holds itself, and the script
whose hash it names.
"""

import base64
import hashlib
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Environment

HERE = Path(__file__).parent


def render(template: str, script: str = "", **values: object) -> str:
    """Return a page.

    Args:
        template: a file of this folder.
        script: a file of this folder that the page runs; none where empty.
        values: what the template names. Strings are escaped unless they are `markupsafe.Markup`.
    """
    code = (HERE / script).read_text() if script else ""
    digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    return _environment().get_template(template).render(values, script=code, script_sha256=digest)


@cache
def _environment() -> "Environment":
    from jinja2 import Environment, FileSystemLoader, StrictUndefined  # here, since viewers do without it

    return Environment(
        loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
