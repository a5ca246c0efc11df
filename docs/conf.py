"""Settings of the documentation site. `scripts/docs` builds the site in build/docs."""

from importlib.metadata import version as installed_version
from importlib.util import find_spec

project = "reslrb"
author = "The reslrb developers"
copyright = "The reslrb developers"  # Sphinx reads this name
version = release = installed_version("reslrb")

extensions = ["myst_nb", "sphinx_copybutton", "sphinx-mathjax-offline"]
source_suffix = {".md": "myst-nb", ".ipynb": "myst-nb"}
# Templates and records of generated pages
exclude_patterns = ["benchmarks/*", "paper/*"]

myst_enable_extensions = ["dollarmath", "colon_fence"]
# Formulas are ```math blocks, which code hosts show, too
myst_fence_as_directive = ["math"]
# Links to headings work as on code hosts
myst_heading_anchors = 4
# `$ command` and prices are no formulas
myst_dmath_allow_space = False
myst_dmath_double_inline = True

# The notebooks are stored without output; `scripts/docs` runs them in a temporary folder
nb_execution_mode = "auto"
nb_execution_in_temp = True
nb_execution_timeout = 600
nb_execution_raise_on_error = True
# The extra `docs` does not install PyTorch
nb_execution_excludepatterns = [] if find_spec("torch") else ["notebooks/network.ipynb"]
# Progress bars and log lines of the notebooks
nb_output_stderr = "remove"

html_theme = "furo"
html_title = f"reslrb {version}"
html_show_sphinx = False
html_theme_options = {"sidebar_hide_name": False}
templates_path: list[str] = []
