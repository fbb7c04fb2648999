"""The value `ExportSource`: a scene to export, and what is known of it."""

from dataclasses import dataclass, field

from jaxtyping import Bool
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats.scenes.scene_file import SceneMetadata


@dataclass(frozen=True)
class ExportSource:
    """A scene, and where it is the result of a transfer, what it was made from; all in one frame."""

    scene: Gaussians
    """The scene; of a transfer the relit one, n Gaussians."""
    title: str
    """What pages call it."""
    is_object: Bool[Tensor, "n"] | None = None
    """Which Gaussians of `scene` belong to an object; None where it is not known."""
    pasted: Gaussians | None = None
    """The same scene before the light transfer."""
    place: Gaussians | None = None
    """The target without object and shadow."""
    cameras: Cameras | None = None
    """Those of the capture that the scene was made from."""
    metadata: SceneMetadata = field(default_factory=SceneMetadata)
    """Up direction and size of a world unit, where they are known."""
