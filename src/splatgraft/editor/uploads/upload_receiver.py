"""Receives files from the upload form of the editor's page, over a websocket of their own.

The form announces a file, then sends its first and last bytes, by which an interrupted upload of the same file is
found, then the bytes that are missing, in parts. Each part is acknowledged once it is in the file, and the form sends
only a few parts ahead, so that both sides hold little in memory. Nothing here imports torch.
"""

import asyncio
import contextlib
import json
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from splatgraft.editor.uploads.incoming_upload import SAMPLE_BYTES, AnnouncedFile, IncomingUpload, UploadRules

UPLOAD_PATH = "upload"
"""Address of the websocket, below that of the page."""
PART_BYTES = 1 << 20
"""Largest part that is accepted."""
_ALIVE_SECONDS = 5.0
"""Time between two messages while a file is checked, so that the form knows that the connection holds."""
_KNOWN_ENDS = 8
"""Uploads whose end is remembered, for a form whose connection was lost just then."""
_LOCKED = "another window edits this project"
_LOADING = "the page is being loaded"
_TAKEN_OVER = "the upload goes on in another connection"

Answer = dict[str, Any]
"""What the form is told; `type` says what it means."""


@dataclass(frozen=True)
class UploadForm:
    """What happens with the uploads of one form."""

    rules: Callable[[], UploadRules]
    """Gives the rules."""
    on_arrived: Callable[[IncomingUpload], None]
    """Stores an upload of which all bytes have arrived, in a thread of its own; raises ValueError if it is bad."""


@dataclass(frozen=True)
class _Announcement:
    """The first message of a form."""

    window: str
    """Key of the window."""
    form: str
    """Which form of the page."""
    attempt: str
    """What tells one choice of a file from the next; the same when the connection is made again."""
    file: AnnouncedFile
    """The file."""


@dataclass(eq=False)
class _Transfer:
    """An upload at work."""

    announcement: _Announcement
    upload: IncomingUpload
    digest: str


class UploadReceiver:
    """At most one upload at a time, of the window that edits; the newest connection counts."""

    def __init__(self, may_edit: Callable[[str], bool | None]) -> None:
        """Start without forms.

        Args:
            may_edit: Whether the window with a key holds the edit lock; None where no open window has that key.
        """
        self._may_edit = may_edit
        self._forms: dict[str, UploadForm] = {}
        self._current: _Transfer | None = None
        self._checks: dict[str, asyncio.Task[Answer]] = {}
        self._ends: dict[str, asyncio.Task[Answer]] = {}
        self._file_lock = asyncio.Lock()
        self.on_refused: Callable[[str], None] = lambda reason: None
        """Called with the reason when a file was refused."""
        self.on_changed: Callable[[], None] = lambda: None
        """Called when an upload has begun, was interrupted or has ended."""

    @property
    def current(self) -> IncomingUpload | None:
        """The upload that is being received; None where there is none."""
        transfer = self._current
        return None if transfer is None else transfer.upload

    def register(self, name: str, form: UploadForm) -> None:
        """Receive the uploads of a form."""
        self._forms = {**self._forms, name: form}

    async def serve(self, connection: ServerConnection) -> None:
        """Receive one upload from a websocket whose access was checked."""
        with contextlib.suppress(ConnectionClosed):
            try:
                answer = await self._answer(connection)
            except (ValueError, OSError) as error:
                answer = self._refusal(error)
            await connection.send(json.dumps(answer))

    async def _answer(self, connection: ServerConnection) -> Answer:
        """Receive an upload; gives the last message to the form."""
        announcement = _parse_announcement(await connection.recv())
        obstacle = self._obstacle(announcement)
        if obstacle is not None:
            return obstacle
        form = self._forms.get(announcement.form)
        if form is None:
            raise ValueError(
                f"{announcement.file.name}: expected one of the page's upload forms, found '{announcement.form[:40]}'"
            )
        rules = form.rules()
        rules.accepted_path(announcement.file)
        await connection.send(json.dumps({"type": "sample"}))
        sample = await connection.recv()
        if isinstance(sample, str) or len(sample) > 2 * SAMPLE_BYTES:
            raise ValueError(f"{announcement.file.name}: expected its first and last bytes, found another message")
        digest = announcement.file.digest(sample)
        end = self._ends.get(announcement.attempt) or self._checks.get(digest)
        if end is None:
            transfer = await self._begin(announcement, rules, digest)
            try:
                answer = await self._receive(connection, transfer)
            finally:
                await self._release(transfer)
            if answer is not None:
                return answer
            end = self._ends[announcement.attempt]
        return await _told_when_done(connection, end)

    def _obstacle(self, announcement: _Announcement) -> Answer | None:
        """Why a window may not upload now; None where it may."""
        may_edit = self._may_edit(announcement.window)
        if may_edit is None or not self._forms:
            return {"type": "wait", "text": _LOADING}
        return None if may_edit else {"type": "locked", "text": _LOCKED}

    async def _begin(self, announcement: _Announcement, rules: UploadRules, digest: str) -> _Transfer:
        """Open the file; an upload of an older connection ends, and what has arrived of it is kept."""
        async with self._file_lock:
            if self._current is not None:
                self._current.upload.pause()
                self._current = None
            upload = await asyncio.to_thread(IncomingUpload, rules, announcement.file, digest)
            transfer = self._current = _Transfer(announcement, upload, digest)
        self.on_changed()
        return transfer

    async def _receive(self, connection: ServerConnection, transfer: _Transfer) -> Answer | None:
        """Write what arrives; gives the last message to the form, None where all bytes have arrived."""
        upload = transfer.upload
        await connection.send(json.dumps({"type": "start", "at": upload.received}))
        while not upload.is_complete:
            message = await connection.recv()
            async with self._file_lock:
                if self._current is not transfer:
                    return {"type": "wait", "text": _TAKEN_OVER}
                obstacle = self._obstacle(transfer.announcement)
                if obstacle is not None:
                    return obstacle
                if isinstance(message, str):
                    # the only text after the announcement is a wish to cancel
                    upload.discard()
                    return {"type": "cancelled"}
                if len(message) > PART_BYTES:
                    raise ValueError(f"{upload.path.name}: expected parts of {PART_BYTES} bytes, found a larger one")
                await asyncio.to_thread(upload.add, message)
            await connection.send(json.dumps({"type": "received", "bytes": upload.received}))
        check = self._checks[transfer.digest] = asyncio.create_task(self._finish(transfer))
        self._ends[transfer.announcement.attempt] = check
        for oldest in list(self._ends)[:-_KNOWN_ENDS]:
            del self._ends[oldest]
        return None

    async def _release(self, transfer: _Transfer) -> None:
        async with self._file_lock:
            if self._current is transfer:
                self._current = None
                transfer.upload.pause()
        self.on_changed()

    async def _finish(self, transfer: _Transfer) -> Answer:
        """Check and store an upload; gives the last message to the form."""
        try:
            await asyncio.to_thread(self._forms[transfer.announcement.form].on_arrived, transfer.upload)
            return {"type": "stored", "text": f"{transfer.upload.path.name}: stored"}
        except (ValueError, OSError) as error:
            return self._refusal(error)
        except Exception as error:  # a programming error must be visible and must not leave the form waiting
            traceback.print_exc()
            return self._refusal(error)
        finally:
            del self._checks[transfer.digest]
            self.on_changed()

    def _refusal(self, error: Exception) -> Answer:
        reason = " ".join(str(error).split())
        self.on_refused(reason)
        return {"type": "refused", "text": reason}


async def _told_when_done(connection: ServerConnection, end: "asyncio.Task[Answer]") -> Answer:
    while not end.done():
        await connection.send(json.dumps({"type": "checking"}))
        await asyncio.wait({end}, timeout=_ALIVE_SECONDS)
    return end.result()


def _parse_announcement(message: str | bytes) -> _Announcement:
    """Raises: ValueError where the message is none of the form's."""
    try:
        found = json.loads(message)
        words = [found[key] for key in ("window", "form", "attempt", "name")]
        numbers = [found[key] for key in ("size", "modified")]
        if not all(isinstance(word, str) and len(word) < 1000 for word in words):
            raise ValueError
        if not all(isinstance(number, int) for number in numbers):
            raise ValueError
    except (ValueError, KeyError, TypeError, RecursionError):
        raise ValueError("upload: expected a file's name, size and time, found another message") from None
    return _Announcement(words[0], words[1], words[2], AnnouncedFile(words[3], numbers[0], numbers[1]))
