"""Sphinx settings: pages from docs/, the reference from the packages' `__all__`, equations as MathML."""

import sys
from pathlib import Path

# The pages describe this checkout, not an installed version.
sys.path[:0] = [str(Path(__file__).parent / "_ext"), str(Path(__file__).parents[1])]
from worldstate.ground.version import __version__  # noqa: E402

project = "worldstate"
author = "the worldstate authors"
version = release = __version__

extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "myst_parser", "mathml", "reference"]
myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
exclude_patterns = ["_build", "examples"]

# A single backtick in a docstring marks an object: a link if the object is exported, else code.
default_role = "py:obj"
nitpicky = True
# Parameter types are phrases ("ndarray, shape (M,)"), and objects that are not exported have no page.
nitpick_ignore_regex = [("py:(class|obj|exc)", ".*")]

autodoc_member_order = "bysource"
# The types in docstrings contain shapes and units; annotations do not.
autodoc_typehints = "none"
autodoc_class_signature = "mixed"
maximum_signature_line_length = 90
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = "worldstate"
html_static_path = ["_static"]
html_css_files = ["style.css"]
html_math_renderer = "mathml"
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
pygments_style = "friendly"
