"""Sphinx configuration."""

from importlib import metadata

from sb3_policyflow import __version__

project = "sb3-policyflow"
author = "The sb3-policyflow developers"
copyright = "2026, the sb3-policyflow developers"  # noqa: A001  # the name that Sphinx reads
version = release = __version__

extensions = [
    "myst_nb",
    "sphinx-mathjax-offline",  # formulas without a connection
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
]
myst_enable_extensions = ["amsmath", "colon_fence", "dollarmath"]
myst_heading_anchors = 3
# Tutorials are run with small budgets when the pages are built.
nb_execution_mode = "cache"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True
copybutton_exclude = ".linenos, .gp, .go"
# An override without a docstring of its own is not listed again.
autodoc_inherit_docstrings = False
autodoc_member_order = "bysource"
# Types stand beside the parameters that a docstring describes, not in the signature.
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
exclude_patterns = ["_build", "results/*/*.md", "**.ipynb_checkpoints"]
html_theme = "furo"
html_title = "sb3-policyflow"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
try:
    _urls = dict(
        line.split(", ", 1) for line in metadata.metadata(project).get_all("Project-URL") or ()
    )
except metadata.PackageNotFoundError:
    _urls = {}
if "Repository" in _urls:
    html_theme_options = {
        "source_repository": _urls["Repository"],
        "source_branch": "main",
        "source_directory": "docs/",
    }
