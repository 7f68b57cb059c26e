"""Sphinx: Markdown pages, a gallery that is run at each build, and a reference made of the packages' ``__all__``."""

import sys
from pathlib import Path

import torch_denkf

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "torch_denkf"
author = copyright = "The torch_denkf developers"
version = release = torch_denkf.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_gallery.gen_gallery",
    "sphinx_copybutton",
    "sphinx_design",
    "reference_pages",
    "repository_links",
]
exclude_patterns = ["_build", "_ext", "tutorials", "gallery/*.ipynb", "gallery/*.py*", "gallery/*.zip"]

myst_enable_extensions = ["amsmath", "dollarmath", "colon_fence", "html_image"]
myst_heading_anchors = 3

autodoc_inherit_docstrings = False  # torchrl's docstrings are torchrl's to show
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_default_options = {"members": True, "private-members": "_AcceptedKeys", "show-inheritance": True}
autosummary_generate = False  # the tables link to entries of the same page
napoleon_use_ivar = True
napoleon_use_rtype = False
maximum_signature_line_length = 88

sphinx_gallery_conf = {
    "examples_dirs": "tutorials",
    "gallery_dirs": "gallery",
    "within_subsection_order": "gallery_order.ReadingOrder",
    "download_all_examples": False,
    "show_memory": False,
    "copyfile_regex": "",
    "backreferences_dir": None,
}

html_theme = "furo"
html_title = f"torch_denkf {version}"
html_copy_source = False
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
