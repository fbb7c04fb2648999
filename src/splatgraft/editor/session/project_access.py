"""What the editor asks of a project: where its files are, what is stale, how to run it. Made by `steps/edit.py`."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

from splatgraft.composition import PlaceOptions
from splatgraft.project.layout import Side
from splatgraft.relighting import RelightOptions

LightBy = Literal["transfer", "gain", "off"]
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class ProjectFiles:
    """Where the files of one project are; most need not exist yet."""

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
    pictured: tuple[bool, bool]
    """Whether the source and the target are scenes without photographs: their pictures were made of them."""
    light_by: LightBy
    """What [relight] asks for: the physical transfer, a gain of the object alone, or nothing."""
    relighting: RelightOptions
    """What it says of the physical transfer."""
    placing: PlaceOptions
    """What [compose] says of the place, where none is decided yet."""

    @property
    def transfers_light(self) -> bool:
        """Whether there is a light to find and to aim."""
        return self.light_by == "transfer"


@runtime_checkable
class Project(Protocol):
    """One project, there or about to be."""

    @property
    def file(self) -> Path:
        """Where project.toml is or will be."""
        ...

    def files(self) -> ProjectFiles | None:
        """Its files as project.toml says now; None where there is no project.toml yet.

        Raises: ValueError where it is broken.
        """
        ...

    def reasons(self) -> Mapping[str, str | None]:
        """Why each step is stale, None where it is not, in the order of the flow."""
        ...

    def create(self, captures: tuple[Path, Path], *, scenes: tuple[Path | None, Path | None]) -> None:
        """Write project.toml for two captures or scenes, source first, and scenes that were trained on these captures.

        Raises: ValueError where one of them is not there, or a project is.
        """
        ...

    def set_view(self, side: Side, *, up: Triple | None, look: str | None) -> None:
        """Say how a scene without photographs is looked at; None: its up is found, it is looked at from around."""
        ...

    def run_command(self, to: str, title: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The child process that does what is stale up to the step `to`, and the words a person would type."""
        ...
