"""Receives the uploads of viser's upload buttons: viser itself would collect them in memory and join them there."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import viser
from viser import _messages

if TYPE_CHECKING:
    from splatgraft.editor.access.uploads import IncomingUpload, UploadRules

UPLOAD_MESSAGES = (_messages.FileTransferStartUpload, _messages.FileTransferPart)
_HIDE_AFTER = 0.5
"""Seconds until the browser has drawn its notification, which is then hidden."""
Send = Callable[[int, _messages.Message], None]


@dataclass(frozen=True)
class UploadButton:
    """What happens with the uploads of one button."""

    rules: Callable[[], UploadRules]
    """Gives the rules."""
    on_stored: Callable[[IncomingUpload], None]
    """Called in a thread of its own with an upload of which all bytes have arrived."""


class UploadReceiver:
    """At most one upload at a time, in parts, to the disk."""

    def __init__(self, send: Send) -> None:
        """Start without buttons; `send` sends a message to a window."""
        self._send = send
        self._buttons: dict[str, UploadButton] = {}
        self._current: tuple[int, str, str, IncomingUpload] | None = None
        self._lock = threading.Lock()
        self.on_refused: Callable[[str], None] = lambda reason: None
        self.on_progress: Callable[[IncomingUpload | None], None] = lambda upload: None

    def register(self, button: viser.GuiUploadButtonHandle, uploads: UploadButton) -> None:
        """Receive the uploads of a button."""
        self._buttons[button._impl.uuid] = uploads

    def receive(self, window: int, message: _messages.Message) -> None:
        """Handle the start or a part of an upload; parts of an upload that was refused or cancelled are ignored."""
        if isinstance(message, _messages.FileTransferStartUpload):
            self._start(window, message)
        elif isinstance(message, _messages.FileTransferPart):
            self._add(window, message)

    def cancel(self) -> None:
        """Discard the upload; nothing where there is none."""
        with self._lock:
            current, self._current = self._current, None
        if current is not None:
            window, button, transfer, upload = current
            upload.discard()
            self._release(window, button, transfer)
            self.on_progress(None)
            self.on_refused(f"{upload.path.name}: the upload was cancelled")

    def window_closed(self, window: int) -> None:
        """Discard the upload of a window that closed."""
        if self._current is not None and self._current[0] == window:
            self.cancel()

    def _start(self, window: int, message: _messages.FileTransferStartUpload) -> None:
        # it loads torch, which takes seconds, and the server starts before that
        from splatgraft.editor.access.uploads import IncomingUpload

        button, uploads = message.source_component_uuid, self._buttons.get(message.source_component_uuid)
        try:
            if uploads is None:
                raise ValueError(f"{message.filename}: expected an upload button that is in use, found another")
            if self._current is not None:
                raise ValueError(
                    f"{message.filename}: expected one upload at a time, found another at work; wait for it"
                )
            upload = IncomingUpload(uploads.rules(), message.filename, message.size_bytes)
        except (ValueError, OSError) as error:
            self._release(window, button, message.transfer_uuid)
            self.on_refused(" ".join(str(error).split()))
            return
        with self._lock:
            self._current = (window, button, message.transfer_uuid, upload)
        self.on_progress(upload)

    def _add(self, window: int, message: _messages.FileTransferPart) -> None:
        with self._lock:
            current = self._current
            if current is None or current[:3] != (window, message.source_component_uuid, message.transfer_uuid):
                return
            upload = current[3]
            try:
                upload.add(message.part_index, message.content)
            except (ValueError, OSError) as error:
                self._current, failed = None, " ".join(str(error).split())
            else:
                failed = None
                self._current = None if upload.is_complete else current
        _, button, transfer, _ = current
        if failed is not None:
            upload.discard()
            self._release(window, button, transfer)
            self.on_progress(None)
            self.on_refused(failed)
            return
        self._send(window, _messages.FileTransferPartAck(button, transfer, upload.received, upload.size))
        self.on_progress(upload)
        if upload.is_complete:
            threading.Thread(target=self._finish, args=(button, upload), daemon=True).start()

    def _finish(self, button: str, upload: IncomingUpload) -> None:
        try:
            self._buttons[button].on_stored(upload)
        finally:
            upload.discard()
            self.on_progress(None)

    def _release(self, window: int, button: str, transfer: str) -> None:
        """Make the browser's button usable again, without a notification that claims success."""
        # the button waits while fewer bytes have arrived than there are, and the notification says `done` at the end:
        # a size below zero is neither
        self._send(window, _messages.FileTransferPartAck(button, transfer, 0, -1))
        notification = _messages.RemoveNotificationMessage(f"upload-{transfer}")
        timer = threading.Timer(_HIDE_AFTER, lambda: self._send(window, notification))
        timer.daemon = True
        timer.start()
