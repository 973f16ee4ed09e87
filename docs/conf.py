"""The pages as a site: `make docs`. Nothing in them is fetched from a network, when built or when read."""

from __future__ import annotations

from importlib.metadata import version as version_of

from docutils.nodes import SkipNode, math, math_block
from latex2mathml.converter import convert
from sphinx.application import Sphinx

project = "ShellGS"
author = "The ShellGS contributors"
copyright = author
release = version = version_of("shellgs")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["conf.py"]
html_theme = "furo"
html_title = "ShellGS"
html_show_sphinx = False
html_copy_source = False
smartquotes = False

add_module_names = False
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 100
napoleon_numpy_docstring = False
# Shapes such as Float[Tensor, "H W 3"] are strings that only jaxtyping reads.
suppress_warnings = ["sphinx_autodoc_typehints", "ref.python", "myst.xref_missing_include"]


def setup(app: Sphinx) -> None:
    """Write equations as MathML, which browsers draw themselves."""
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_block, None))


html_math_renderer = "mathml"


def _inline(translator, node: math) -> None:
    translator.body.append(convert(node.astext()))
    raise SkipNode


def _block(translator, node: math_block) -> None:
    translator.body.append(f'<div class="math">{convert(node.astext(), display="block")}</div>')
    raise SkipNode
