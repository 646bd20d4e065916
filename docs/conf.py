"""The site: `pip install '.[docs]' && sphinx-build docs docs/_build`, without a network."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

import jaxchain

project = "jaxchain"
author = "The jaxchain authors"
copyright = author
release = version = jaxchain.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.intersphinx",
    "sphinx_design",
    "sphinx_copybutton",
    "sphinx-mathjax-offline",  # formulas without a network
    # Those of this folder:
    "docstrings",
    "examples",
    "inventories",
    "names",
    "reference",
    "sections",
]

exclude_patterns = ["_build", "extensions", "inventories", "jupyter_execute"]
nitpicky = True

# Notebooks are shown as they were executed last; `.ci/run` executes them.
nb_execution_mode = "off"
myst_enable_extensions = ["attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

# Shapes and units stand in the docstrings, which annotations would only repeat.
autodoc_typehints = "none"
autodoc_class_signature = "mixed"
autodoc_inherit_docstrings = False
autodoc_member_order = "bysource"
add_module_names = False
toc_object_entries_show_parents = "hide"

# Prompts are not copied, nor what is printed.
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

html_theme = "pydata_sphinx_theme"
html_title = "jaxchain"
html_favicon = "static/favicon.svg"
html_context = {"default_mode": "auto"}
html_static_path = ["static"]
html_css_files = ["jaxchain.css"]
html_js_files = ["enlarge.js", ("search.js", {"defer": "defer"})]
# Pages without siblings have no sidebar.
html_sidebars = {page: [] for page in ("index", "start", "faq", "why", "cite", "examples/README")}
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "logo": {
        "image_light": "static/logo.svg",
        "image_dark": "static/logo.svg",
        "alt_text": "jaxchain",
    },
    "search_as_you_type": True,
    "header_links_before_dropdown": 6,
    "navigation_with_keys": False,
    "show_toc_level": 2,
    "footer_start": ["copyright"],
    "footer_end": [],
    "secondary_sidebar_items": ["page-toc"],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
