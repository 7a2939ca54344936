"""How Sphinx builds the manual: `make docs`. Its sources are where they are read on the forge, too."""

import gc
import sys
from pathlib import Path

# The trees of all pages stay until the end: looking for garbage among them again and again takes a sixth of the time.
gc.disable()

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "tools/roots"), str(ROOT / "docs" / "_ext")]

project = "Loopwright"
author = "the Loopwright authors"
copyright = "the Loopwright authors, Apache-2.0"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "manual.extension"]

# Sphinx reads from the repository's root, so that a link from page to page is the same here and there.
root_doc = "docs/index"
include_patterns = [
    "docs/**.md",
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "examples/**/README.md",
    "examples/notebooks/*.ipynb",
    "pipeline/cases/bibliography.md",
    "pipeline/cases/*/README.md",
]
exclude_patterns = [".*", "artifacts", "build", "mlruns", "tests", "tools", "work", "**/node_modules", "docs/_*"]

myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 4
# Notebooks are shown as they are stored: tools/run_notebooks.py executes them.
nb_execution_mode = "off"
html_math_renderer = "mathml"
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_type_aliases = {name: name for name in ("ArrayLike", "Array")}

html_theme = "furo"
html_title = "Loopwright"
html_static_path = ["_static"]
html_extra_path = ["_extra"]
html_css_files = ["manual.css"]
html_copy_source = False
html_show_sphinx = False
templates_path = []
