"""What the preview's worker is to draw, and the key of a view."""

from dataclasses import dataclass, replace
from pathlib import Path

import viser

from splatgraft.core.cameras import Cameras
from splatgraft.editor.previews.preview import NEEDS_LIGHT, PictureKind
from splatgraft.editor.session.edit_state import EditState
from splatgraft.editor.session.session import Session

SOURCE_KINDS: tuple[PictureKind, PictureKind] = ("Source", "Object alone")
"""Kinds of images of the source."""


@dataclass(frozen=True)
class PictureRequest:
    """What the worker is to draw."""

    session: Session
    state: EditState
    camera: Cameras
    left: PictureKind
    right: PictureKind
    split: float
    window: viser.ClientHandle | None
    """The window whose canvas shows the picture; None: the panel shows it."""
    is_dragging: bool = False
    """Whether something is being dragged; then a draft suffices."""
    is_moved: bool = False
    """Whether the camera has moved; the picture is drawn when it rests."""
    draft: bool = False
    """Whether a draft of the light is drawn."""
    budget: int | None = None
    """Maximum number of Gaussians that are drawn; None: all."""
    is_sample: bool = False
    """Whether a sample of the scene is drawn, which needs no whole scene in memory."""

    def without_light(self) -> "PictureRequest":
        """The same with pictures of the pasted object in place of those that need the light transfer."""
        left, right = ("Copy-paste" if kind in NEEDS_LIGHT else kind for kind in (self.left, self.right))
        return replace(self, left=left, right=right)

    def scenes(self) -> tuple[Path, ...]:
        """The files of the scenes that the picture needs."""
        if self.left in SOURCE_KINDS:
            return (self.session.files.source_scene,)
        return self.session.placed_scenes()

    """Maximum number of Gaussians; None: all."""


def pose_of(camera: Cameras) -> bytes:
    """Pose, intrinsics and size, which identify a view."""
    return b"".join(part.numpy().tobytes() for part in (camera.world_from_camera, camera.intrinsics, camera.sizes))
