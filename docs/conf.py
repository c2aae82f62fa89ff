"""Sphinx configuration."""

from sb3_policyflow import __version__

project = "sb3-policyflow"
author = "The sb3-policyflow developers"
copyright = "2026, the sb3-policyflow developers"  # noqa: A001  # the name that Sphinx reads
version = release = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
]
myst_enable_extensions = ["amsmath", "dollarmath"]
myst_heading_anchors = 3
# An override without a docstring of its own is not listed again.
autodoc_inherit_docstrings = False
autodoc_member_order = "bysource"
# Types stand beside the parameters that a docstring describes, not in the signature.
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
exclude_patterns = ["_build", "results/*/*.md"]
html_theme = "furo"
html_title = "sb3-policyflow"
html_static_path = ["_static"]
html_css_files = ["tables.css"]
