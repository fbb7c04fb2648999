"""The edited project: its files by project.toml, the stale steps, and the commands that run them."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from splatgraft.commands.init import Init
from splatgraft.exports.export import Layer
from splatgraft.formats import is_scene
from splatgraft.project.layout import (
    CAMERAS_FILE,
    PLACEMENT_FILE,
    SCENE_FILE,
    SELECTION_FILE,
    SIDES,
    SURROUNDINGS_FILE,
    Side,
)
from splatgraft.project.toml_edit import with_keys
from splatgraft.relighting import LayerWeights
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import atomic_write, relative_name
from splatgraft.steps.capture import Capture
from splatgraft.steps.compose import Compose
from splatgraft.steps.relight import Relight
from splatgraft.steps.segment import Segment
from splatgraft.workflow.flow import read_flow, reasons


@dataclass(frozen=True)
class ProjectFiles:
    """Paths and options of one project; most files need not exist yet."""

    file: Path
    """project.toml; placement.json, light.json, erased.npy and corrections.npy lie beside it."""
    root: Path
    """Folder of all results and exports."""
    scenes: Mapping[Side, Path]
    """The reconstructions: with the object, and into which it is placed."""
    cameras: Mapping[Side, Path]
    """transforms.json of the posed captures, which lies beside the photographs."""
    object: Path
    """The object's Gaussians."""
    surroundings: Path
    """The source without the object."""
    selection: Path
    """Flags of the source's Gaussians that are the object."""
    placement: Path
    """The composite's placement.json, which names its objects."""
    relit: Path
    """The composite with the light transfer."""
    result: Path
    """The consolidated scene."""
    report: Path
    """The folder of index.html."""
    captures: Mapping[Side, Capture]
    """The steps that make the posed source and target."""
    compose: Compose
    """The step that places the objects."""
    relight: Relight
    """The step of the light transfer."""

    def has_photos(self, side: Side) -> bool:
        """Return whether a side has photographs; otherwise its images are rendered from a trained scene."""
        return not is_scene(self.captures[side].capture)

    @property
    def have_both_scenes(self) -> bool:
        """Whether both reconstructions exist."""
        return all(scene.is_file() for scene in self.scenes.values())

    @property
    def transfers_light(self) -> bool:
        """Whether the physical light transfer is used, so that there is a light to estimate and edit."""
        return self.relight.light == "transfer"


@dataclass(frozen=True)
class Project:
    """A project whose project.toml may not exist yet."""

    file: Path
    """project.toml."""
    out: Path | None = None
    """Folder of all results; None: the folder of project.toml."""

    @property
    def root(self) -> Path:
        """Folder of all results."""
        return self.file.parent if self.out is None else self.out

    def files(self) -> ProjectFiles:
        """Read the project's files; raise ValueError if project.toml does not exist or is invalid."""
        flow = read_flow(self.file, self.out)
        layout, compose = flow.layout, flow.typed(Compose)
        return ProjectFiles(
            file=self.file,
            root=layout.root,
            scenes={"source": flow.typed(Segment).scene, "target": compose.target},
            cameras={side: layout.capture(side) / CAMERAS_FILE for side in SIDES},
            object=compose.object,
            surroundings=layout.object / SURROUNDINGS_FILE,
            selection=layout.object / SELECTION_FILE,
            placement=layout.composite / PLACEMENT_FILE,
            relit=layout.relit / SCENE_FILE,
            result=layout.result / SCENE_FILE,
            report=layout.report,
            captures={side: flow.typed(Capture, f"{side}/capture") for side in SIDES},
            compose=compose,
            relight=flow.typed(Relight),
        )

    def reasons(self) -> Mapping[str, str | None]:
        """Return why each step is stale, as in `status`; raise ValueError if project.toml is invalid."""
        return reasons(read_flow(self.file, self.out))

    def create(self, captures: tuple[Path, Path], *, scenes: tuple[Path | None, Path | None]) -> None:
        """Write project.toml for two captures or scene files, and for scenes trained on them if given."""
        for scene in scenes:
            if scene is not None and not scene.is_file():
                raise ValueError(f"{scene}: expected a trained scene, found no such file")
        Init(folder=self.file.parent, source=captures[0], target=captures[1]).execute(Console())
        for side, scene in zip(SIDES, scenes, strict=True):
            if scene is not None:
                self.set_keys(side, {"scene": relative_name(scene, self.file.parent)})

    def set_keys(self, table: str, keys: Mapping[str, object]) -> None:
        """Set keys of a table of project.toml; None removes a key."""
        text = with_keys(self.file.read_text(encoding="utf-8"), table, keys)
        with atomic_write(self.file) as stream:
            stream.write(text.encode())

    def run_words(self, to: str) -> tuple[str, ...]:
        """Return the arguments of `splatgraft` that run the stale steps up to `to`."""
        out = () if self.out is None else ("--out", str(self.out))
        return ("run", str(self.file), "--to", to, *out)

    def export_words(self, to: Path, layer: Layer | Literal["report"]) -> tuple[str, ...]:
        """Return the arguments of `splatgraft` that write the result, a part of it or the report."""
        part = () if layer == "all" else ("--page", layer) if layer == "report" else ("--layer", layer)
        return ("export", str(self.root), "--to", str(to), *part)


_WEIGHTS = tuple(field.name for field in fields(LayerWeights))
_EDITS = {
    "placement.json": "you moved the object",
    "erased.npy": "you erased part of the place",
    "corrections.npy": "you changed the selection",
    "prompts.json": "you clicked in the photos",
    "light.json": "you changed the light",
    "scene.ply": "the scene that it is made from is a new one",
}


def in_words(step: str, reason: str) -> str:
    """Rephrase why a step is stale in the user's words; keep other reasons."""
    # `compose` finds a place from the cameras until one is set by hand
    if step == "compose" and reason.partition(":")[0] in ("cameras", "placement"):
        return _EDITS["placement.json"]
    if step == "relight" and reason.partition(" is now ")[0] in _WEIGHTS:
        return _EDITS["light.json"]
    if reason.startswith("waits for "):
        return f"after {reason.removeprefix('waits for ')}"
    return next((words for file, words in _EDITS.items() if f": {file} changed" in reason), reason)
