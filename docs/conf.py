"""Sphinx configuration: these documents, and the API reference from docstrings (numpydoc)."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from pygments.lexers import TextLexer  # noqa: E402
from sphinx.application import Sphinx  # noqa: E402

from rosafe.system.version import VERSION  # noqa: E402

project = "rosAFE in Python"
copyright = "the rosAFE maintainers"
version = release = VERSION

extensions = ["sphinx.ext.autodoc", "sphinx.ext.autosummary", "numpydoc", "myst_parser"]
root_doc = "index"
exclude_patterns = ["_build", "README.md"]
source_suffix = {".rst": "restructuredtext", ".md": "markdown"}
html_theme = "alabaster"
html_title = f"rosAFE {VERSION}"
templates_path: list[str] = []

autodoc_member_order = "bysource"
numpydoc_class_members_toctree = False
numpydoc_show_class_members = False
numpydoc_validation_checks = {"GL06", "GL07", "GL08", "PR01", "PR02", "PR03", "PR10", "RT03", "SS01", "YD01"}
numpydoc_validation_exclude = {r"^rosafe\.[a-z]+\."}  # only the public names of `rosafe` are checked
myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath"]
myst_dmath_allow_space = False
suppress_warnings = ["myst.header"]  # headings of some pages begin below the first


def setup(app: Sphinx) -> None:
    """Show nft rules without highlighting: Pygments has no lexer for them."""
    app.add_lexer("nft", TextLexer)


myst_url_schemes = ("http", "https")
