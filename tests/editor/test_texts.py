"""All texts of the page's controls, in one file that is read as a whole: texts.txt beside this test."""

import re
from pathlib import Path
from typing import Any

from test_hostile_values import made, page_of, project

__all__ = ["made", "project"]
TEXTS = Path(__file__).with_name("texts.txt")


def texts_of(page: Any) -> list[str]:
    """Labels, hints and options of all controls and upload forms, and names of the commands, in alphabetical order."""
    gui, found = page.server.gui, set()
    for handle in (*gui._gui_input_handle_from_uuid.values(), *gui._container_handle_from_uuid.values()):
        props = getattr(handle, "_impl", None)
        for name in ("label", "hint"):
            found.add(getattr(getattr(props, "props", None), name, None))
        found |= set(getattr(getattr(props, "props", None), "options", None) or ())
        for child in getattr(handle, "_children", {}).values():
            found |= set(re.findall(r'<splatgraft-upload [^>]*label="([^"]*)"', str(getattr(child, "content", ""))))
    return sorted(text for text in found if isinstance(text, str) and text.strip())


def test_the_page_s_texts_are_those_that_were_reviewed(project: Path) -> None:
    page, close = page_of(project)
    try:
        page.show_phase("Open")
        # names of files and times change
        found = [text for text in texts_of(page) if not text.endswith(".ply") and "%" not in text]
    finally:
        close()
    lines = TEXTS.read_text(encoding="utf-8").splitlines() if TEXTS.is_file() else []
    assert found == lines, "\n".join(found)
