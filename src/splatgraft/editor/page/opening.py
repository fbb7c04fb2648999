"""What a window shows while torch loads and the scenes are read: a sample of the scene of the first phase.

Nothing here imports torch. Where a project.toml chooses other files, or there is no scene yet, nothing is shown.
"""

import threading
import tomllib
from pathlib import Path

import numpy as np
import viser

from splatgraft.editor.scene_sample import SceneSample, View, read_first_view, read_sample
from splatgraft.project.layout import CAMERAS_FILE, ERASED_FILE, OBJECT_FILE, SCENE_FILE, Layout, Side

COARSE_NODE = "/coarse"
"""The node of the sample."""
_PANEL_WIDTH = 372
"""Pixels; the narrowest at which three numbers are legible beside their label."""
_POINT_SIZE = 0.5
"""Size of a point over the median Gaussian's enlarged standard deviation."""
_MOVED = 1e-3
"""Distance of a view from where it was set, over that to what it looks at, above which its user has moved it."""
_OTHER_FILES = (("compose", "target"), ("compose", "object"), ("segment", "scene"))
"""Keys of project.toml that name files outside the layout."""


class Opening:
    """The sample of a scene in all windows, seen through its first camera."""

    def __init__(self, server: viser.ViserServer, project: Path, root: Path) -> None:
        """Show the scene that the first phase will show, where it can be told from the files.

        Args:
            server: The server of the windows.
            project: project.toml, which need not exist.
            root: The folder of the results.
        """
        set_theme(server)
        self._server, self._lock = server, threading.Lock()
        self._placed: dict[int, View] = {}
        self._is_open = True
        self.scene: Path | None = None
        """File of the scene that is shown; None where none is."""
        side = _first_side(project, Layout(root))
        if side is None:
            return
        scene, view = Layout(root).scene(side) / SCENE_FILE, None
        sample = read_sample(scene)
        if sample is None:
            return
        if side == "target":
            sample = _without_erased(sample, project.parent / ERASED_FILE)
        if not len(sample.means):
            return
        add_coarse(server, sample)
        self.scene, view = scene, read_first_view(Layout(root).capture(side) / CAMERAS_FILE)
        if view is not None:
            server.on_client_connect(lambda client: self._place(client, view))

    def close(self) -> frozenset[int]:
        """Leave the windows to the page; gives those whose user has moved the view meanwhile."""
        with self._lock:
            self._is_open = False
            windows = self._server.get_clients()
            return frozenset(number for number, view in self._placed.items() if _has_left(windows.get(number), view))

    def _place(self, window: viser.ClientHandle, view: View) -> None:
        with self._lock:
            if self._is_open:
                self._placed[window.client_id] = view
                look_through(window, view)


def _has_left(window: viser.ClientHandle | None, view: View) -> bool:
    if window is None:
        return False
    distance = float(np.linalg.norm(view.look_at - view.position))
    return float(np.linalg.norm(np.asarray(window.camera.position) - view.position)) > _MOVED * distance


def set_theme(server: viser.ViserServer) -> None:
    """The look of the page and the place of its panel."""
    gui = server.gui
    gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=(224, 122, 46))
    gui.set_panel_label("splatgraft")
    gui.main_panel.dock_right()
    gui.main_panel.set_width(_PANEL_WIDTH)
    server.scene.world_axes.visible = False


def add_coarse(server: viser.ViserServer, sample: SceneSample) -> viser.PointCloudHandle:
    """Show a sample of a scene as points, in place of an earlier one.

    Points need no sorting and no blending, and small ones little filling: a browser without a GPU would draw as many
    splats, or points as large as them, for half a minute while nothing else happens on the page.
    """
    solid = sample.select(sample.opacity_logits > 0)
    widths = np.exp(np.sort(solid.log_scales, axis=1)[:, 1])
    return server.scene.add_point_cloud(
        COARSE_NODE,
        solid.means,
        solid.colors,
        point_size=_POINT_SIZE * float(np.median(widths)) if len(widths) else 1.0,
        point_shape="square",
        point_shading="flat",
        precision="float32",
    )


def look_through(window: viser.ClientHandle, view: View) -> None:
    """Move a window's view to a camera, with its whole picture in view however narrow the window is."""
    half = view.half_height
    if window.camera.aspect > 0:
        half *= max(1.0, view.aspect / window.camera.aspect)
    with window.atomic():
        window.camera.up_direction = view.up
        window.camera.position = view.position
        window.camera.look_at = view.look_at
        window.camera.fov = 2 * float(np.arctan(half))


def _first_side(project: Path, layout: Layout) -> Side | None:
    """The scene of the first phase, as `Page` chooses it; None where it cannot be told."""
    try:
        content = tomllib.loads(project.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    for table, key in _OTHER_FILES:
        found = content.get(table)
        if isinstance(found, dict) and key in found:
            return None
    if not all((layout.scene(side) / SCENE_FILE).is_file() for side in ("source", "target")):
        return None
    return "target" if (layout.object / OBJECT_FILE).is_file() else "source"


def _without_erased(sample: SceneSample, erased: Path) -> SceneSample:
    try:
        flags = np.load(erased, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return sample
    return sample.without(flags) if flags.dtype == bool and flags.ndim == 1 else sample
