"""Settings of Sphinx: ``sphinx-build -n -W docs build/site``."""

import pydoc
from configparser import ConfigParser
from importlib.metadata import version as version_of
from importlib.resources import files
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

project = "lnocl"
author = "The lnocl developers"
copyright = "2026, The lnocl developers"
release = version = version_of("lnocl")
setup_cfg = ConfigParser()
setup_cfg.read(Path(__file__).parents[1] / "setup.cfg", encoding="utf-8")

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "sphinxarg.ext",
]
templates_path = ["_templates"]
nitpicky = True
# The domain of the shell's options takes no links by name.
suppress_warnings = ["myst.domains"]
# rho' and rho'' have straight quotes.
smartquotes = False

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "substitution"]
myst_substitutions = {
    "version": version,
    "repository": f"[the repository]({setup_cfg['metadata']['url']})",
}
myst_heading_anchors = 4

default_role = "py:obj"
autodoc_typehints = "none"
autosummary_generate = True
numpydoc_show_class_members = False

# With ``-t online`` names of other packages are links; without, nothing is fetched.
intersphinx_mapping = {
    name: (f"https://{address}", None)
    for name, address in {
        "python": "docs.python.org/3",
        "numpy": "numpy.org/doc/stable",
        "astropy": "docs.astropy.org/en/stable",
        "photutils": "photutils.readthedocs.io/en/stable",
    }.items()
    if tags.has("online")  # noqa: F821 (Sphinx defines it)
}

sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r"/examples/[^/]+\.py$",
    "abort_on_example_error": True,
    "write_computation_times": False,
    "download_all_examples": False,
    "within_subsection_order": "FileNameSortKey",
}

# Browsers set MathML themselves, so that equations need no network. The package ziamath ships the
# font of mathematics that they need (STIX Two Math, SIL Open Font License).
html_math_renderer = "mathml"
html_theme = "pydata_sphinx_theme"
html_title = f"lnocl {release}"
html_static_path = ["_static", str(files("ziamath") / "fonts" / "STIXTwoMath-Regular.ttf")]
html_css_files = ["lnocl.css"]
html_show_sourcelink = False
# These have no pages below them.
html_sidebars = {"comparison": [], "glossary": []}
html_theme_options = {
    "show_prev_next": True,
    "navigation_with_keys": False,
    "header_links_before_dropdown": 6,
}
# Commands are copied without their prompts and outputs.
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
copybutton_line_continuation_character = "\\"
copybutton_selector = "div.highlight:not(.highlight-output *) pre"


def name_without_page(app, env, node, contnode):
    """Show parameters, and names of the code that exist but have no page, as code."""
    name = node["reftarget"]
    if node.get("reftype") == "obj" and (name.isidentifier() or pydoc.locate(name) is not None):
        return nodes.literal(text=name)
    return None


def show_inline(writer, node):
    """Write a formula of a line."""
    writer.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def show_block(writer, node):
    """Write an equation."""
    writer.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app):
    """Connect what Sphinx calls."""
    app.add_html_math_renderer("mathml", (show_inline, None), (show_block, None))
    app.connect("missing-reference", name_without_page)
