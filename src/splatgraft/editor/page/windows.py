"""The browser windows on the page: their cameras, and a notice in each window without the edit lock."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import viser

from splatgraft.core.cameras import Cameras
from splatgraft.editor.page.opening import look_through
from splatgraft.editor.session.scene_sample import View

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_FIRST = -2.0
"""Order in the panel of what stands above all else."""
_WATCH_NOTE = (
    '<div class="sg-watch" style="font-size:.85em;line-height:1.45;padding:6px 12px 0">You are watching: another window'
    " edits this project. You can turn the view; the controls below have no effect here.</div>"
)


class Windows:
    """All open windows; one of them holds the edit lock."""

    def __init__(self, page: Page) -> None:
        """Start without windows; `connect` makes them known."""
        self._keep_view: frozenset[int] = frozenset()
        self._page, self._guarded, self._server = page, page.guarded, page.server
        self._notices: dict[int, Sequence[Callable[[], None]]] = {}
        self._views: dict[str, tuple[Any, ...]] = {}
        self.on_moved: list[Callable[[int], None]] = []
        """Called with the number of a window whose view or shape has changed."""

    def connect(self, moved: frozenset[int]) -> None:
        """Handle windows that are open, open and close from now on; the page must be built.

        Args:
            moved: Numbers of the windows that keep their view, as their user has moved it.
        """
        self._keep_view = moved
        self._guarded.on_edit_lock_changed = self._holder_changed
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)

    def editing(self) -> viser.ClientHandle | None:
        """The window that holds the edit lock; None where no window is open."""
        holder = self._guarded.edit_lock.holder
        return None if holder is None else self._server.get_clients().get(holder)

    def watching(self) -> tuple[viser.ClientHandle, ...]:
        """The windows that do not hold the edit lock."""
        holder = self._guarded.edit_lock.holder
        return tuple(client for number, client in self._server.get_clients().items() if number != holder)

    def look_through(self, camera: Cameras) -> None:
        """Move the editing window's view to a camera."""
        window = self.editing()
        if window is None:
            return
        pose = camera.world_from_camera[0].double().numpy()
        view = View(
            position=pose[:3, 3],
            look_at=pose[:3, 3] + pose[:3, 2] * self._page.scene_scale(),
            up=-pose[:3, 1],
            half_height=camera.height / (2 * float(camera.intrinsics[0, 1, 1])),
            aspect=camera.width / camera.height,
        )
        look_through(window, view)

    def save_view(self, scene: str) -> None:
        """Store the editing window's view of `scene`."""
        window = self.editing()
        if window is not None:
            camera = window.camera
            self._views[scene] = (camera.position, camera.look_at, camera.up_direction, camera.fov)

    def restore_view(self, scene: str) -> None:
        """Restore the stored view of `scene`; the first time, look through its first camera."""
        window, view = self.editing(), self._views.get(scene)
        if window is None:
            return
        if view is None:
            self._set_first_view(window)
            return
        with window.atomic():
            window.camera.up_direction = view[2]
            window.camera.position, window.camera.look_at, window.camera.fov = view[0], view[1], view[3]

    def _connected(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda _: self._moved(client.client_id))
        if client.client_id not in self._keep_view:
            self._set_first_view(client)
        self._update_notices()
        self._page.preview.update()

    def _disconnected(self, client: viser.ClientHandle) -> None:
        self._notices.pop(client.client_id, None)

    def _moved(self, window: int) -> None:
        self._page.preview.camera_moved(window)
        for call in self.on_moved:
            call(window)

    def _set_first_view(self, client: viser.ClientHandle) -> None:
        editing = self.editing()
        if editing is not None and editing.client_id != client.client_id:
            _copy_view(editing.camera, client)
            return
        # the reconstruction covers what the first photograph shows
        camera = self._page.preview.first_camera()
        if camera is not None and editing is not None:
            self.look_through(camera)

    def _holder_changed(self) -> None:
        self._update_notices()
        self._page.preview.holder_changed()

    def _update_notices(self) -> None:
        for number, client in self._server.get_clients().items():
            holds = number == self._guarded.edit_lock.holder
            notice = self._notices.get(number)
            if holds and notice is not None:
                self._remove_notice(number)
            elif not holds and notice is None:
                self._notices[number] = self._show_notice(client)

    def _remove_notice(self, number: int) -> None:
        for remove in self._notices.pop(number, ()):
            remove()

    def _show_notice(self, client: viser.ClientHandle) -> Sequence[Callable[[], None]]:
        """Ask a window that opened, or lost the edit lock, what it is for; gives the calls that remove the notice."""
        modal = client.gui.add_modal("Open in another window")
        with modal:
            client.gui.add_markdown("This project is being edited in another window. This window is read-only.")
            watch = client.gui.add_button("Watch", color="gray")
            watch.on_click(lambda _: self._watch(client))
            self._add_take_button(client)
        return (modal.close,)

    def _watch(self, client: viser.ClientHandle) -> None:
        """Leave the scene of a window free to look at; its panel says that it is read-only."""
        self._remove_notice(client.client_id)
        note = client.gui.add_html(_WATCH_NOTE, order=_FIRST)
        take = self._add_take_button(client, order=_FIRST + 1)
        self._notices[client.client_id] = (note.remove, take.remove)

    def _add_take_button(self, client: viser.ClientHandle, order: float | None = None) -> viser.GuiButtonHandle:
        take = client.gui.add_button("Edit here instead", order=order)
        take.on_click(lambda _: self._guarded.take_edit_lock(client.client_id))
        return take


def _copy_view(camera: viser.CameraHandle, to: viser.ClientHandle) -> None:
    with to.atomic():
        to.camera.up_direction = camera.up_direction
        to.camera.position, to.camera.look_at, to.camera.fov = camera.position, camera.look_at, camera.fov
