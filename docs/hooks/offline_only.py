"""Fails the build where a page would load a script, a style, a font or a picture from the network."""

import re

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.pages import Page

_TAGS = "script|link|img|iframe|source|video|object"
_LOADED = re.compile(rf"<(?:{_TAGS})\b[^>]*?\b(?:src|href|data)=[\"']?(?:https?:)?//[^>]*>")


def on_post_page(output: str, *, page: Page, config: MkDocsConfig) -> str:
    """Look at one finished page."""
    if found := _LOADED.search(output):
        raise PluginError(f"{page.file.src_uri}: expected files of the site alone, found {found[0]}")
    return output
