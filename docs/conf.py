# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sphinx's settings of this site: `make docs`, or `rosdoc2 build --package-path .`."""

import re
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

_HERE = Path(__file__).resolve().parent
_USED = ("CHANGELOG.rst", "CONTRIBUTING.md", "config", "examples", "tsobs_ros")
"""Sources outside docs/ that pages show or link to."""

# rosdoc2 copies docs/ elsewhere and runs this text from a file that names the original.
_wrapper = re.search(r'open\("(.+)conf\.py"\)', Path(__file__).read_text(encoding="utf-8"))
_ROOT = Path(_wrapper[1]).parent if _wrapper else _HERE.parent
for _name in _USED:
    if not (_HERE.parent / _name).exists():
        (_HERE.parent / _name).symlink_to(_ROOT / _name)
sys.path[:0] = [str(_ROOT), str(_HERE)]

import tsobs_ros  # noqa: E402

project = "tsobs_ros"
author = "The tsobs_ros contributors"
copyright = f"2026 {author}, Apache-2.0"
version = release = tsobs_ros.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "directives",
    "mathml",
]
exclude_patterns = [
    # rosdoc2 generates these; this site has its own.
    "index.rst", "modules.rst", "tsobs_ros*.rst", "standards.rst", "standard_docs", "__*",
]  # fmt: skip
myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath"]
html_math_renderer = "mathml"
# A page is in the contents as soon as it is there.
suppress_warnings = ["toc.not_readable"]

autodoc_typehints = "none"  # the signature has them
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
default_role = "literal"
napoleon_use_rtype = False
napoleon_custom_sections = [("Attributes", "params_style")]

html_title = f"tsobs_ros {release}"
html_theme = "furo" if find_spec("furo") else "alabaster"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_copy_source = False
linkcheck_anchors = False
linkcheck_timeout = 30
# They refuse what is no browser.
linkcheck_ignore = [r"https://doi\.org/"]

rosdoc2_settings: dict[str, Any] = {"override_theme": False}
