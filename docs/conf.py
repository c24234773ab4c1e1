"""Settings of Sphinx for the docs site: `make site`, and rosdoc2 by rosdoc2.yaml.

The pages are the Markdown of this folder as it stands; the reference of the API comes from the docstrings.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

project = "agv_ncs"
author = "The agv_ncs developers"
copyright = author  # noqa: A001 - Sphinx' name for it

# rosdoc2 runs a copy of this folder, in one below the package or elsewhere, and knows the version.
package = None
for folder in Path(__file__).resolve().parents:
    if (folder / "package.xml").is_file():
        sys.path.insert(0, str(folder))
        release = re.findall(r"<version>(.+?)</version>", (folder / "package.xml").read_text(encoding="utf-8"))[0]
        html_title = f"agv_ncs {release}"
        package = folder
        break

extensions = ["myst_parser", "sphinx.ext.autodoc"]
default_role = "code"
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True

html_theme = "furo"
html_show_sphinx = False
html_copy_source = False
smartquotes = False


def literal_blocks(_app: Any, _what: str, _name: str, _obj: Any, _options: Any, lines: list[str]) -> None:
    """Make an indented block of a docstring what it is in Markdown: code as it stands."""
    for i in range(len(lines) - 1, 0, -1):
        begins = lines[i].startswith("    ") and not lines[i - 1] and not lines[i - 2].startswith("    ")
        if begins:
            lines[i:i] = ["::", ""]


def included(app: Any, _name: str, source: list[str]) -> None:
    """Have a page that is a file of the package's root be that file where a copy of this folder does not lie beside it.

    Links there go to docs/, which is the folder of the page.
    """
    file = re.match(r"```\{include\} \.\./(\S+)", source[0])
    if file is not None and package is not None and not (Path(app.srcdir).parent / file[1]).is_file():
        source[0] = (package / file[1]).read_text(encoding="utf-8").replace("](docs/", "](")


def setup(app: Any) -> None:
    """Register what Sphinx calls for each docstring and for each page."""
    app.connect("autodoc-process-docstring", literal_blocks)
    app.connect("source-read", included)
