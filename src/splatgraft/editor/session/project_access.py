"""The project as the editor needs it: files, stale steps, commands. `commands/edit_project.py` implements it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

from splatgraft.composition import PlaceOptions
from splatgraft.exports.export import Layer
from splatgraft.project.layout import Side
from splatgraft.relighting import RelightOptions

LightMode = Literal["transfer", "gain", "off"]
ExportPage = Literal["viewer", "report"]
"""What an exported .html holds."""
Commands = tuple[tuple[str, ...], tuple[str, ...]]
"""The command line of a child process, and its equivalent for the user."""
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class RenderedViews:
    """How images of a scene without photographs are rendered."""

    up: Triple | None = None
    """Up direction in the scene's frame; None: estimated."""
    is_within: bool = False
    """Whether the cameras look outwards from the middle of the scene, else at it from around."""


@dataclass(frozen=True)
class ProjectFiles:
    """Paths and options of one project; most files need not exist yet."""

    file: Path
    """project.toml; placement.json, light.json, erased.npy and corrections.npy lie beside it."""
    root: Path
    """All results; uploads and exports too."""
    source_scene: Path
    """The reconstruction with the object."""
    target_scene: Path
    """The reconstruction that receives it."""
    source_cameras: Path
    """transforms.json of the posed source."""
    target_cameras: Path
    """transforms.json of the posed target."""
    target_capture: Path
    """The posed target, with its photographs."""
    object: Path
    """The object's Gaussians."""
    surroundings: Path
    """The source without the object."""
    selection: Path
    """Which Gaussians of the source are the object."""
    composite: Path
    """The pasted scene."""
    placement: Path
    """The composite's placement.json, which names its objects."""
    relit: Path
    """The composite with the light transfer."""
    light: Path
    """light.json as estimated, or as given."""
    result: Path
    """The consolidated scene."""
    report: Path
    """The folder of index.html."""
    without_photos: tuple[bool, bool]
    """Whether source and target are scenes without photographs, whose images are rendered from the scene."""
    rendered_views: tuple[RenderedViews, RenderedViews]
    """How the images of source and target are rendered, where they are scenes without photographs."""
    light_mode: LightMode
    """`light` of [relight]: the physical transfer, a gain of the object alone, or nothing."""
    relight_options: RelightOptions
    """`options` of [relight]."""
    place_options: PlaceOptions
    """Placement options of [compose], for objects without a placement."""

    @property
    def transfers_light(self) -> bool:
        """Whether the physical light transfer is used, so that there is a light to estimate and edit."""
        return self.light_mode == "transfer"


@runtime_checkable
class Project(Protocol):
    """A project whose project.toml may not exist yet."""

    @property
    def file(self) -> Path:
        """Path of project.toml."""
        ...

    def files(self) -> ProjectFiles | None:
        """Its files according to project.toml; None where project.toml does not exist yet.

        Raises:
            ValueError: If project.toml is invalid.
        """
        ...

    def reasons(self) -> Mapping[str, str | None]:
        """For each step, in the order of the flow, why it is stale; None where it is up to date."""
        ...

    def describe(self, path: Path) -> tuple[str, bool]:
        """What is at a path, in one line, and whether a project can be made of it; nothing is changed."""
        ...

    def create(self, captures: tuple[Path, Path], *, scenes: tuple[Path | None, Path | None]) -> None:
        """Write project.toml.

        Args:
            captures: Source and target: captures or scene files.
            scenes: Scenes trained on these captures, where there are any.

        Raises:
            ValueError: If one of the files is missing, or project.toml exists.
        """
        ...

    def set_view(self, side: Side, views: RenderedViews) -> None:
        """Set how images of a scene without photographs are rendered."""
        ...

    def run_command(self, to: str, title: str) -> Commands:
        """Commands that run the stale steps up to `to`."""
        ...

    def export_command(self, to: Path, *, page: ExportPage, layer: Layer, title: str) -> Commands:
        """Commands that write the result, or a part of it, as a file whose suffix names the format."""
        ...
