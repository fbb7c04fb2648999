"""What a window shows while torch loads and the scenes are read: a sample of the scene of the first phase.

Nothing here imports torch. Where a project.toml chooses other files, or there is no scene yet, nothing is shown.
"""

import threading
import tomllib
from pathlib import Path

import numpy as np
import viser

from splatgraft.editor.page.splat_arrays import SplatArrays, splat_arrays
from splatgraft.editor.session.scene_sample import SceneSample, View, read_first_view, read_sample
from splatgraft.project.layout import CAMERAS_FILE, ERASED_FILE, OBJECT_FILE, SCENE_FILE, Layout, Side

COARSE_NODE = "/coarse"
"""The node of the sample."""
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
        self._server, self._lock = server, threading.Lock()
        self._placed: set[int] = set()
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
        """Leave the windows that open from now on to the page; gives those whose view was set."""
        with self._lock:
            self._is_open = False
            return frozenset(self._placed)

    def _place(self, window: viser.ClientHandle, view: View) -> None:
        with self._lock:
            if self._is_open:
                self._placed.add(window.client_id)
                look_through(window, view)


def add_coarse(server: viser.ViserServer, sample: SceneSample) -> viser.GaussianSplatHandle:
    """Show a sample of a scene, in place of an earlier one."""
    arrays = splat_arrays(
        sample.means,
        sample.log_scales,
        sample.quaternions,
        opacity_logits=sample.opacity_logits,
        band_0=sample.band_0,
    )
    return add_splats(server.scene, COARSE_NODE, arrays)


def add_splats(scene: viser.SceneApi, name: str, arrays: SplatArrays) -> viser.GaussianSplatHandle:
    """Add a node of splats in the world's frame."""
    handle = scene.add_gaussian_splats(
        name, centers=arrays.centers, covariances=arrays.covariances, rgbs=arrays.rgbs, opacities=arrays.opacities
    )
    handle.scale = arrays.unit
    return handle


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
