"""The upload forms of the panel, which `uploads/upload_form.js` draws, and what waits to be continued."""

from __future__ import annotations

import html
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import viser

from splatgraft.editor.uploads.incoming_upload import (
    KEPT_DAYS,
    IncomingUpload,
    InterruptedUpload,
    UploadRules,
    interrupted_uploads,
)
from splatgraft.editor.uploads.upload_checks import check_file
from splatgraft.editor.uploads.upload_receiver import UploadForm

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_NOTE_STYLE = "font-size:.8em;line-height:1.4;padding:0 12px 6px"


class UploadForms:
    """All forms of the page."""

    def __init__(self, page: Page) -> None:
        """Start without forms."""
        self._page, self._receiver = page, page.guarded.uploads
        self._forms: dict[str, UploadForm] = {}
        self._notes: list[tuple[viser.GuiHtmlHandle, tuple[str, ...]]] = []

    def open(self) -> None:
        """Receive files from now on; the page must be built."""
        self._receiver.on_refused = lambda reason: self._page.say(reason, bad=True)
        self._receiver.on_changed = self.show_interrupted
        for name, form in self._forms.items():
            self._receiver.register(name, form)
        self.show_interrupted()

    def add(self, label: str, suffixes: tuple[str, ...], on_file: Callable[[Path], None]) -> None:
        """Add a form for files with these suffixes to the panel; `on_file` gets the path of a stored one."""
        page, name = self._page, label.lower().replace(" ", "-")

        def store(upload: IncomingUpload) -> None:
            # a large scene is checked while the page stays usable
            page.say(f"{upload.path.name}: uploaded, being checked")
            path = upload.finish()
            page.callback(lambda _: on_file(path))(None)

        shown = f'form="{name}" label="{html.escape(label)}" accept="{",".join(suffixes)}"'
        page.gui.add_html(f"<splatgraft-upload {shown}></splatgraft-upload>")
        self._notes.append((page.gui.add_html("", visible=False), suffixes))
        folder = page.project.file.parent
        self._forms[name] = UploadForm(lambda: UploadRules(folder, suffixes, check_file), store)

    def add_progress(self) -> None:
        """Add what shows the progress of an upload while its form is out of view."""
        self._page.gui.add_html("<splatgraft-upload-progress></splatgraft-upload-progress>")

    def show_interrupted(self) -> None:
        """Name under each form what can be continued."""
        current = self._receiver.current
        found = [
            upload
            for upload in interrupted_uploads(self._page.project.file.parent)
            if upload.received < upload.size and (current is None or upload.name != current.path.name)
        ]
        for note, suffixes in self._notes:
            lines = [_line(upload) for upload in found if Path(upload.name).suffix.lower() in suffixes]
            note.content = f'<div class="sg-interrupted" style="{_NOTE_STYLE}">{"<br>".join(lines)}</div>'
            note.visible = bool(lines)


def _line(upload: InterruptedUpload) -> str:
    return (
        f"{html.escape(upload.name)}: {upload.received / 1e6:,.1f} of {upload.size / 1e6:,.1f} MB have arrived; choose"
        f" the file again to continue within {KEPT_DAYS} days"
    )
