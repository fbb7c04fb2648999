"""The command `try`: the whole flow on two captures without earlier decisions, as a draft and then finer."""

import re
import shlex
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from splatgraft.capture import read_doubts
from splatgraft.commands.init import Init
from splatgraft.folders.input_description import describe_input
from splatgraft.project.layout import PROJECT_FILE, REPORT_FILE
from splatgraft.project.record import read_record
from splatgraft.project.step import Positional, Step, default_remedy
from splatgraft.project.toml_edit import with_keys
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.note import Note
from splatgraft.runtime.process import open_page
from splatgraft.runtime.settings import read_toml
from splatgraft.steps.capture import Capture
from splatgraft.steps.compose import Compose
from splatgraft.steps.relight import Relight
from splatgraft.steps.segment import Segment
from splatgraft.workflow.flow import Flow, read_flow
from splatgraft.workflow.run import run_steps

DRAFT = {"quality": "draft"}
"""Keys of [reconstruct] for the draft."""
_FINER = {"draft": "standard", "standard": "high"}  # the next finer quality


@dataclass(frozen=True)
class Try:
    """Run the whole flow on two captures: first a draft, whose report opens, then again with the place at standard
    quality, which replaces the draft. The same command continues after an interruption. Poses that are not plausible
    are used, with a warning."""

    object: Positional
    """The capture with the object: photos (a folder or a .zip), a video, a COLMAP folder, a folder with
    transforms.json, a trained scene (.ply, .spz, .splat), or a mesh (.glb, .gltf, .obj, .stl, .ply)."""
    place: Positional
    """The capture or the scene that receives it."""
    out: Path | None = None
    """Folder of the project; if not given, OBJECT_into_PLACE here, with a number if that name is taken."""
    draft: bool = False
    """Stop at the draft."""
    keep_closed: bool = False
    """Print the report's path without opening it in the browser."""

    def execute(self, console: Console) -> int:
        """Write the project, run it, and print the doubts about its result with remedies."""
        folder = self.out or self._free_folder()
        self._write_project(folder, console)
        project = folder / PROJECT_FILE
        page = read_flow(project).layout.report / REPORT_FILE
        run_steps(project, console, accept_doubtful=True)
        if not self.keep_closed and open_page(page):
            console.say(f"{page}: opened in the browser")
        if _quality(project) == "draft" and not self.draft:
            console.say(f"{page}: the draft; the place at standard quality follows and replaces it, or Ctrl-C keeps it")
            with atomic_write(project) as stream:
                text = project.read_text(encoding="utf-8")
                stream.write(with_keys(text, "reconstruct", {"quality": _FINER["draft"]}).encode())
            run_steps(project, console, accept_doubtful=True)
        for line in refinements(read_flow(project), folder):
            console.say(line)
        return 0

    def _free_folder(self) -> Path:
        """Return the folder of an earlier try of these captures, or else a new OBJECT_into_PLACE."""
        name = f"{_name(self.object)}_into_{_name(self.place)}"
        for folder in (Path(name if i == 1 else f"{name}_{i}") for i in count(1)):
            project = folder / PROJECT_FILE
            sides = Init(folder, source=self.object, target=self.place).sides()
            if not folder.exists() or (project.is_file() and _same_captures(project, sides)):
                return folder
        raise AssertionError

    def _write_project(self, folder: Path, console: Console) -> None:
        """Write a project at draft quality; an earlier one of these captures is kept, because it may be finer now."""
        project = folder / PROJECT_FILE
        init = Init(folder, source=self.object, target=self.place)
        if project.is_file():
            if not _same_captures(project, init.sides()):
                raise ValueError(f"{project}: expected a project of these captures, found others; name --out FOLDER")
            console.say(f"{project}: continues with the existing results")
            return
        for capture in (self.object, self.place):
            found = describe_input(capture)
            if not found.is_usable:
                known = found.text.startswith(str(capture))
                raise ValueError(
                    found.text if known else f"{capture}: expected a capture or a scene, found {found.text}"
                )
        text = with_keys(init.text(), "reconstruct", DRAFT)
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(project) as stream:
            stream.write(text.encode())
        console.say(f"{project}: written, for a draft first")


def refinements(flow: Flow, folder: Path) -> list[str]:
    """List the doubts about each step of a finished project, the worst one with its remedy, and how to get finer
    results."""
    shown = Path(shlex.quote(str(folder)))
    lines: list[str] = []
    doubts: list[tuple[Step, Note]] = []
    for name, step in flow:
        record = read_record(step.out)
        if record is None:
            continue
        mended = [note.text for note in record.warnings if not note.in_doubt]
        own = [*_guesses(step), *(note for note in record.warnings if note.in_doubt)]
        doubts += [(step, note) for note in own]
        if mended:
            lines.append(f"noted: {name}: {mended[0]}{_more(mended)}")
        if own:
            lines.append(f"unsure: {name}: {own[0].text}{_more(own)}")
    if doubts:
        step, note = min(doubts, key=lambda one: _rank(*one))
        picture = f" ({step.out / note.picture})" if note.picture else ""
        lines.append(f"worst: {note.text}{picture}")
        remedy = note.remedy or default_remedy(step)
    else:
        lines.append("no step warned of its result: look at the pictures; the cut of the object is mended most often")
        remedy = Segment.remedy
    if remedy:
        lines.append(f"helps most: {remedy.replace('PROJECT', str(shown))}")
    quality = _FINER.get(_quality(folder / PROJECT_FILE) or "")
    finer = f'finer: quality = "{quality}" under [reconstruct] in {shown / PROJECT_FILE}, then splatgraft run {shown}'
    return [*lines, *([finer] if quality else [])]


def _rank(step: Step, note: Note) -> tuple[int, bool]:
    """Rank a doubt by its effect on the picture, the worst first.

    The order is wrong poses, the object, its light, its placement, other steps. A guess without a remedy comes after
    the step's measured faults.
    """
    if isinstance(step, Capture):
        of_poses = any(str(doubt) in note.text for doubt in read_doubts(step.out))
        return (0 if of_poses else 4), not note.remedy
    order = (Segment, Relight, Compose)
    return next((1 + i for i, kind in enumerate(order) if isinstance(step, kind)), 4), not note.remedy


def _quality(project: Path) -> str | None:
    """Return the quality of the place's reconstruction; None if not given, or if the place is a trained scene."""
    content = read_toml(project)
    return None if "scene" in content["target"] else content.get("reconstruct", {}).get("quality")


def _more(some: Sequence[object]) -> str:
    return f" (and {len(some) - 1} more)" if len(some) > 1 else ""


def _guesses(step: Step) -> list[Note]:
    """List the guesses of a step that the user gave no masks or clicks."""
    if not isinstance(step, Segment):
        return []
    if (step.out / "masks").is_dir() and step.box is None and step.prompts is None:
        return [Note("no masks and no clicks were given: the object is assumed to stand where the cameras look.")]
    text = "the object is everything inside a box; masks cut it more precisely."
    return [Note(text)] if step.mask_source == "box" else []


def _name(capture: Path) -> str:
    """Make a short name for folders: `photos/vase/images` gives vase."""
    path = capture.resolve()
    path = path.parent if path.name in ("images", "photos", "transforms.json") else path
    return re.sub(r"[^\w.-]+", "_", path.stem if path.is_file() else path.name)


def _same_captures(project: Path, sides: tuple[str, str]) -> bool:
    """Whether a project has the captures that two lines of project.toml name."""
    content = read_toml(project)
    wanted = zip(("source", "target"), map(tomllib.loads, sides), strict=True)
    return all(content.get(side, {}).items() >= line.items() for side, line in wanted)


COMMAND = Try
