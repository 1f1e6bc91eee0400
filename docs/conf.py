"""How Sphinx builds the site from the Markdown pages in this folder: `make docs`, or rosdoc2."""

from __future__ import annotations

import re
from pathlib import Path

project = 'flexmanip_ros'
copyright = 'the flexmanip_ros maintainers, Apache-2.0'
# rosdoc2 runs this file from another folder, and sets the version itself.
declared = Path(__file__).resolve().parents[1] / 'setup.py'
if declared.is_file():
    version = release = re.findall(r"version='([\d.]+)'", declared.read_text(encoding='utf-8'))[0]

extensions = ['myst_parser']
source_suffix = {'.md': 'markdown'}
exclude_patterns = ['_build']
myst_enable_extensions = ['colon_fence']
myst_heading_anchors = 3  # page.md#a-heading
# Every link to a page or heading that is not there is an error, and so is a block that is not what it says.
nitpicky = True
highlight_language = 'none'

html_theme = 'alabaster'
html_static_path = ['_static']
html_css_files = ['site.css']
html_show_sourcelink = False
html_show_sphinx = False
html_theme_options = {
    'description': 'A flexible arm, its vibration modes, and the payload it catches',
    'fixed_sidebar': True, 'page_width': '1180px', 'sidebar_width': '250px', 'show_relbars': True,
}
html_sidebars = {'**': ['about.html', 'searchbox.html', 'navigation.html']}
