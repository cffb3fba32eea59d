"""The site of the documentation: Sphinx, since its autodoc reads our numpydoc docstrings.

Nothing is fetched: no remote inventories, no scripts or fonts of other servers.
"""

project = 'anser_ros'
author = 'anser_ros maintainers'
project_copyright = 'anser_ros maintainers, Apache-2.0'
extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon']
exclude_patterns = ['_build']
templates_path: list[str] = []

myst_enable_extensions = ['deflist', 'colon_fence']
myst_heading_anchors = 3

autodoc_member_order = 'bysource'
autodoc_typehints = 'none'  # the docstrings give types with shapes and units
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True

html_theme = 'furo'
html_title = 'anser_ros'
html_static_path = ['_static']
html_css_files = ['site.css']
html_show_sourcelink = False
