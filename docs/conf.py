"""Sphinx: pages in Markdown (MyST), API pages from docstrings.

A line ``<!-- api: PACKAGE -->`` in a page is replaced by the directives of the package's names, and
``<!-- fill: NAME -->`` by what a command prints or a file has too. Other tables that are made from
the code stand in the pages: ``python -m docs.tools`` writes them.
"""

import re
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.ext.napoleon.docstring import NumpyDocstring

sys.path.insert(0, str(Path(__file__).parents[1]))

from docs.tools.api_page import api_page
from docs.tools.command_page import command_page
from docs.tools.config_page import config_page
from docs.tools.faults_page import faults_page
from docs.tools.recording_page import recording_page
from docs.tools.unit_page import objects_page

project = "tactile-cell"
author = "The tactile-cell maintainers"
release = metadata.version("tactile-cell")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["examples"]
html_theme = "furo"
html_title = "tactile-cell"
html_show_copyright = False
html_math_renderer = "mathml"

myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 4

default_role = (
    "py:obj"  # names in single backticks in docstrings become links where there is a target
)
autoclass_content = "both"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
napoleon_numpy_docstring = True
napoleon_google_docstring = False
napoleon_use_ivar = True

suppress_warnings = ["ref.python"]  # words of types, as n_taxels, that several classes have too
nitpicky = True
nitpick_ignore_regex = [("py:.*", ".*")]  # types of other libraries: their sites are not asked


# Texts under fields are whole sentences: without this, what stands before a colon becomes the type.
NumpyDocstring._consume_inline_attribute = lambda self: ("", self._consume_to_end())  # noqa: SLF001


FILLED = {
    "command line": command_page,
    "config": config_page,
    "faults": faults_page,
    "recording": recording_page,
    "unit objects": objects_page,
}
"""What makes each text that a command prints, or a file of the program has, too."""


def fill(_app: Any, _name: str, source: list[str]) -> None:
    """Replace the markers of packages by the directives of their names, others by their texts."""
    page = re.sub("<!-- api: (.+?) -->", lambda match: api_page(match[1]), source[0])
    source[0] = re.sub("<!-- fill: (.+?) -->", lambda match: FILLED[match[1]](), page)


def math(self: Any, node: nodes.math | nodes.math_block) -> None:
    """Write a formula as MathML, which browsers show without a script from elsewhere."""
    block = isinstance(node, nodes.math_block)
    self.body.append(tex2mathml(node.astext(), as_block=block))
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Connect `fill` to the reading of pages, and `math` to their writing."""
    app.connect("source-read", fill)
    app.add_html_math_renderer("mathml", (math, None), (math, None))
