"""Sphinx configuration."""

from sb3_policyflow import __version__

project = "sb3-policyflow"
author = "The sb3-policyflow developers"
copyright = "2026, the sb3-policyflow developers"  # noqa: A001  # the name that Sphinx reads
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax"]
myst_enable_extensions = ["amsmath", "dollarmath"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "none"
exclude_patterns = ["_build", "results/*/*.md"]
html_theme = "furo"
html_title = "sb3-policyflow"
