"""The step `Open`: create a project from two captures or scenes, and reconstruct missing scenes."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from splatgraft.core.capture_orientation import estimate_up
from splatgraft.editor.form import Form
from splatgraft.editor.panel import Panel
from splatgraft.editor.placement import Triple
from splatgraft.editor.session import Session
from splatgraft.folders.input_description import InputDescription, describe_input
from splatgraft.formats import SCENE_SUFFIXES
from splatgraft.project.layout import SIDES, Side

if TYPE_CHECKING:
    from splatgraft.editor.editor import Editor

_HELP = (
    "A capture is a folder of photos, a video, a COLMAP folder, or a folder with a transforms.json. "
    "A trained scene (.ply, .spz, .sog, ...) works as well: its images are rendered from cameras around it."
)
_FIELDS = {
    "source": "Object from",
    "target": "Place into",
    "source_scene": "Scene of the object",
    "target_scene": "Scene of the place",
}
_VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm")
_PHOTOS = (".jpg", ".jpeg", ".png", ".heic", ".tif", ".tiff", ".webp")
_UPS: dict[str, Triple | None] = {
    "as found": None,
    "+z": (0.0, 0.0, 1.0),
    "-y": (0.0, -1.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
    "-z": (0.0, 0.0, -1.0),
    "+x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
}
_LOOKS = {"from around": "around", "from within": "within"}
_TRAINED_HINT = "A trained scene (.ply, .spz, .sog, ...) in the same frame as its capture"
_MAX_ROWS = 300  # listed entries of a folder


class OpenPanel(Panel):
    """Controls of a new project or the open one."""

    def __init__(self, editor: "Editor") -> None:
        """Start without captures."""
        super().__init__(editor)
        self._paths = dict.fromkeys(_FIELDS, "")
        self._found: dict[str, InputDescription | None] = dict.fromkeys(SIDES)
        self._browsed: tuple[str, Path] | None = None
        """Field for which a folder of this machine is shown, and that folder."""

    def build(self, form: Form) -> None:
        """Add the controls of a new project, or those of the open one."""
        session, problem = self.editor.session, self.editor.problem
        if problem is not None:
            form.note(f"This project cannot be opened: {problem}", name="problem", bad=True)
            form.note("Correct the file; the page opens it as soon as it is saved.")
        elif session is None:
            self._build_new(form)
        else:
            self._build_open(form, session)

    # a new project

    def _build_new(self, form: Form) -> None:
        if self._browsed is not None:
            self._build_folder(form, *self._browsed)
            return
        form.note(_HELP, name="help")
        for name in SIDES:
            self._add_path(form, name, "A path")
            found = self._found[name]
            if found is not None:
                form.note(found.text, name=f"found_{name}", bad=not found.is_usable)
            suffixes = (*_PHOTOS, *_VIDEOS, *SCENE_SUFFIXES)
            form.upload(f"upload_{name}", "Upload photos, a video or a scene", suffixes, many=True)
        usable = all(found is not None and found.is_usable for found in self._found.values())
        form.button("start", "Start the project", self._create, main=True, disabled=not usable)
        form.more()
        for name in ("source_scene", "target_scene"):
            self._add_path(form, name, _TRAINED_HINT)

    def _add_path(self, form: Form, name: str, hint: str) -> None:
        """Add the field of a path, with a button that lists the folder of its present value."""
        given = self._paths[name]
        form.text(name, _FIELDS[name], given, partial(self._set, name), hint=hint, browse=True)
        start = Path(given).expanduser() if given and Path(given).expanduser().is_absolute() else Path.home()
        start = next(folder for folder in (start, *start.parents) if folder.is_dir())
        form.hidden(f"browse_{name}", lambda: setattr(self, "_browsed", (name, start)))

    def _build_folder(self, form: Form, name: str, folder: Path) -> None:
        """List the folders and usable files of a folder of this machine."""

        def go(row: str) -> None:
            path = folder.parent if row == ".." else folder / row.removesuffix("/")
            if path.is_dir():
                self._browsed = (name, path)
            else:
                self._use(name, path)

        form.note(f"{_FIELDS[name]}: {folder}", name="folder")
        form.button("use_folder", "Use this folder", partial(self._use, name, folder), main=True)
        form.button("close_folder", "Back", lambda: setattr(self, "_browsed", None))
        try:
            entries = sorted(folder.iterdir(), key=lambda path: (not path.is_dir(), path.name.lower()))
        except OSError as error:
            form.note(f"This folder cannot be read: {error.strerror}", bad=True)
            entries = []
        usable = (*_VIDEOS, *SCENE_SUFFIXES)
        shown = [p for p in entries if not p.name.startswith(".") and (p.is_dir() or p.suffix.lower() in usable)]
        photos = sum(p.suffix.lower() in _PHOTOS for p in entries)
        form.note(f"{photos} photos are in this folder." if photos else "", name="photos")
        rows = [f"{p.name}/" if p.is_dir() else p.name for p in shown[:_MAX_ROWS]]
        form.rows("entries", ["..", *rows], go)

    def _use(self, name: str, path: Path) -> None:
        self._browsed = None
        self._set(name, str(path))

    def _set(self, name: str, value: str) -> None:
        self._paths[name] = value.strip()
        if name in SIDES:
            self._found[name] = None
            self.editor.background.submit(partial(self._look, dict(self._paths)))

    def _look(self, paths: dict[str, str]) -> None:
        """Describe the inputs at the paths."""
        for name in SIDES:
            self._found[name] = describe_input(parse_path(paths[name])) if paths[name] else None
        self.editor.refresh()

    def _create(self) -> None:
        paths = {name: parse_path(text) for name, text in self._paths.items() if text}
        scenes = paths.get("source_scene"), paths.get("target_scene")
        self.editor.project.create((paths["source"], paths["target"]), scenes=scenes)
        self.editor.open_project()
        session = self.session
        if not any(map(session.files.has_photos, SIDES)):
            # importing two scenes takes no training, so it starts at once
            self.editor.run("reconstruct", _title(session))
        else:
            self.editor.say("the project is made; reconstruct both scenes next")

    def uploaded(self, path: Path, use: str) -> None:
        """Use an uploaded file, or the folder of uploaded photos, as a capture."""
        name = use.removeprefix("upload_")
        if name in SIDES and self.editor.session is None:
            self._set(name, str(path.parent if path.suffix.lower() in _PHOTOS else path))

    # the open project

    def _build_open(self, form: Form, session: Session) -> None:
        files = session.files
        for side in SIDES:
            form.note(self._line(session, side), name=f"facts_{side}")
        have_both = files.have_both_scenes
        why = session.why_stale(*(f"{side}/reconstruct" for side in SIDES)) if have_both else None
        form.note("" if why is None else f"Out of date: {why}", name="stale")
        if not have_both or why is not None:
            title = "Update both scenes" if have_both else _title(session)
            form.button("build", title, lambda: self.editor.run("reconstruct", title), main=not have_both)
        form.more()
        for side in SIDES:
            if not files.has_photos(side):
                self._build_views(form, side)

    def _build_views(self, form: Form, side: Side) -> None:
        """Add the choices for rendering a scene without photographs; an up along no axis is an extra option."""
        views, ups = self.session.files.captures[side].look, dict(_UPS)
        if views.up not in ups.values():
            ups[f"({', '.join(f'{x:g}' for x in views.up or ())})"] = views.up

        def set_view(key: str, value: object) -> None:
            self.session.set_view(side, **{key: value})
            self.editor.run("reconstruct", "Render the scene again")

        form.choice(f"look_{side}", f"Cameras: {side}", views.look, _LOOKS, partial(set_view, "look"))
        form.choice(f"up_{side}", f"Up: {side}", views.up, ups, partial(set_view, "up"))

    def _line(self, session: Session, side: Side) -> str:
        name, files = _FIELDS[side], session.files
        if not files.scenes[side].is_file():
            return f"{name}: not built yet"
        text = f"{name}: ready"
        if not files.has_photos(side) and files.cameras[side].is_file():
            made = session.scenes.cameras(side)
            up = ", ".join(f"{round(x, 2) + 0.0:.2f}" for x in estimate_up(made).tolist())
            text += f", without photographs: {len(made)} pictures were rendered of it, with ({up}) as up"
        return text


def parse_path(text: str) -> Path:
    """Return the path in a text field; raise ValueError if it is empty."""
    if not text.strip():
        raise ValueError("path: expected one, found nothing")
    return Path.cwd() / Path(text.strip()).expanduser()


def _title(session: Session) -> str:
    return "Reconstruct both scenes" if any(map(session.files.has_photos, SIDES)) else "Import both scenes"
