"""What a window shows while torch loads and the scenes are read: points of the scene of the first phase.

Nothing here imports torch. Where a project.toml chooses other files, or there is no scene yet, nothing is shown.
"""

import json
import threading
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import viser
from jaxtyping import Float

from splatgraft.editor.scene_sample import SceneSample, read_sample
from splatgraft.project.layout import CAMERAS_FILE, ERASED_FILE, OBJECT_FILE, SCENE_FILE, Layout, Side

COARSE_NODE = "/coarse"
"""The node of the points."""
_PANEL_WIDTH = 372
"""Pixels; the narrowest at which three numbers are legible beside their label."""


@dataclass(frozen=True)
class View:
    """The view through a camera."""

    world_from_camera: Float[np.ndarray, "4 4"]
    """Its pose, OpenCV axes."""
    distance: float
    """From the camera to the point around which the view turns, world units."""
    half_height: float
    """Tangent of half the vertical field of view."""
    aspect: float
    """Width over height."""


class Opening:
    """The points of a scene in all windows, seen through its first camera."""

    def __init__(self, server: viser.ViserServer, project: Path, root: Path) -> None:
        """Show the scene that the first phase of project.toml, with its results in `root`, will show."""
        set_theme(server)
        self._lock, self._is_open = threading.Lock(), True
        self.placed: set[int] = set()
        """Windows that have got the first view, which their users may have moved since."""
        self.scene: Path | None = None
        """File of the scene that is shown; None where none is."""
        side = _first_side(project, layout := Layout(root))
        sample = None if side is None else read_sample(layout.scene(side) / SCENE_FILE)
        if side is None or sample is None:
            return
        if side == "target" and (project.parent / ERASED_FILE).is_file():
            try:
                sample = sample.without(np.load(project.parent / ERASED_FILE, allow_pickle=False))
            except (OSError, ValueError, EOFError, TypeError, IndexError):
                return  # the page says what is wrong with it
        add_coarse(server, sample)
        self.scene, view = layout.scene(side) / SCENE_FILE, read_first_view(layout.capture(side) / CAMERAS_FILE)
        if view is not None:
            server.on_client_connect(lambda window: self._place(window, view))

    def close(self) -> None:
        """Leave the windows to the page."""
        with self._lock:
            self._is_open = False

    def _place(self, window: viser.ClientHandle, view: View) -> None:
        with self._lock:
            if self._is_open:
                look_through(window, view)
                self.placed.add(window.client_id)


def set_theme(server: viser.ViserServer) -> None:
    """The look of the page and the place of its panel."""
    gui = server.gui
    gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=(224, 122, 46))
    gui.set_panel_label("splatgraft")
    gui.main_panel.dock_right()
    gui.main_panel.set_width(_PANEL_WIDTH)
    server.scene.world_axes.visible = False


def add_coarse(server: viser.ViserServer, sample: SceneSample) -> None:
    """Show a sample of a scene, in place of an earlier one.

    Points need no sorting and no blending, and small ones little filling: a browser without a GPU would draw as many
    splats, or points as large as them, for half a minute while nothing else happens on the page.
    """
    server.scene.add_point_cloud(
        COARSE_NODE,
        sample.points,
        sample.colors,
        point_size=sample.point_size,
        point_shape="square",
        point_shading="flat",
        precision="float32",
    )


def look_through(window: viser.ClientHandle, view: View) -> None:
    """Move a window's view to a camera, with its whole picture in view however narrow the window is."""
    half, pose = view.half_height, view.world_from_camera
    if window.camera.aspect > 0:
        half *= max(1.0, view.aspect / window.camera.aspect)
    with window.atomic():
        window.camera.up_direction = -pose[:3, 1]
        window.camera.position = pose[:3, 3]
        window.camera.look_at = pose[:3, 3] + view.distance * pose[:3, 2]
        window.camera.fov = 2 * float(np.arctan(half))


def read_first_view(transforms: Path) -> View | None:
    """The first camera of a transforms.json as this program writes it; None where there is none."""
    try:
        content = json.loads(transforms.read_text(encoding="utf-8"))
        frame = {**content, **content["frames"][0]}
        poses = np.array([one["transform_matrix"] for one in content["frames"]], np.float64).reshape(-1, 4, 4)
        width, height, focal = float(frame["w"]), float(frame["h"]), float(frame["fl_y"])
    except (OSError, ValueError, KeyError, TypeError, IndexError):
        return None
    if not (np.isfinite(poses).all() and min(width, height, focal) > 0):
        return None
    # from OpenGL axes, whose y is up and whose z points back
    pose = poses[0] @ np.diag([1.0, -1.0, -1.0, 1.0])
    return View(pose, typical_distance(poses[:, :3, 3]), height / (2 * focal), width / height)


def typical_distance(centers: Float[np.ndarray, "v 3"]) -> float:
    """Median distance of camera centres from their mean, world units; positive."""
    return max(1e-6, float(np.median(np.linalg.norm(centers - centers.mean(0), axis=1))))


def _first_side(project: Path, layout: Layout) -> Side | None:
    """The scene of the first phase, as `Page` chooses it; None where it cannot be told."""
    try:
        content = tomllib.loads(project.read_text(encoding="utf-8"))
        compose, segment = content.get("compose", {}), content.get("segment", {})
        if "target" in compose or "object" in compose or "scene" in segment:
            return None
    except (OSError, ValueError, TypeError, RecursionError):
        return None
    if not all((layout.scene(side) / SCENE_FILE).is_file() for side in ("source", "target")):
        return None
    return "target" if (layout.object / OBJECT_FILE).is_file() else "source"
