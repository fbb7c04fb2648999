"""What the folders of SynCom hold (ComGS, Gao et al. 2026), after its card and the loader of its authors.

    composition/SCENE_with_OBJECT/   cameras.json, transform.json, images/VIEW.png: the object really in the scene
    scene/SCENE/train, test          cameras.json, images/VIEW.png: the empty scene
    object/OBJECT/train, test        cameras.json, images/VIEW.png (and linear .exr), albedo/, normal/
    results/METHOD/SCENE_with_OBJECT/[frames/]   pictures of a method: not of the data set, put there by the user

The card says which collections there are; names of files are those that the public loader reads. What neither says,
that images/ of a composition is the truth and whether there are masks, is guessed and said.
"""

from pathlib import Path

from splatgraft_paper.tables.paper_numbers import published_name
from splatgraft_paper.tables.paper_scene import LAYOUT_FILE, PaperScene, from_root, subfolders
from splatgraft_paper.tables.picture_folders import picture_folders

TRANSFORM_FILE = "transform.json"
_COMPOSITIONS = "composition"
_RESULTS = "results"
_PICTURES = "images"
"""Of every capture, and of a composition: there the truth."""


def find_syncom(folder: Path) -> tuple[Path, list[PaperScene]]:
    """The data set's root at or below `folder`, and its compositions.

    Raises: ValueError where there is no folder composition/ with a composition in it.
    """
    roots = (folder, folder / "SynCom", folder / "data")
    root = next((root for root in roots if subfolders(root / _COMPOSITIONS)), None)
    if root is None:
        found = ", ".join(path.name for path in subfolders(folder)) or "no folders"
        raise ValueError(f"{folder}: expected composition/SCENE_with_OBJECT in it, found {found}")
    return root, [_inspect(root, path) for path in subfolders(root / _COMPOSITIONS)]


def object_of(name: str) -> str | None:
    """The object of a composition "SCENE_with_OBJECT"; None where the name has none, or more than one."""
    _, _, objects = name.partition("_with_")
    return None if not objects or "_and_" in objects else objects


def _inspect(root: Path, folder: Path) -> PaperScene:
    folders, taken = _pictures(root, folder)
    files: dict[str, Path] = {}
    scene, _, _ = folder.name.partition("_with_")
    name = object_of(folder.name)
    if name is None:
        taken.append(f"{folder.name}: expected SCENE_with_OBJECT; our methods need one object, by its name")
    captures = {
        "target_capture": root / "scene" / scene / "train",
        "source_capture": root / "object" / (name or "") / "train",
        "cameras": folder,
        "placement": folder / TRANSFORM_FILE,
    }
    for key, path in captures.items():
        if path.is_file() or (path / "cameras.json").is_file():
            files[key] = path
            taken.append(f"{from_root(path, root)}: taken for the {key.replace('_', ' ')}, as the authors' loader does")
        else:
            taken.append(f"{from_root(path, root)}: not found; our methods need it as the {key.replace('_', ' ')}")
    results = _results(root, folder.name)
    taken += [f"{from_root(path, root)}: taken for pictures of {method}" for method, path in results.items()]
    if not results:
        taken.append(f"{_RESULTS}/METHOD/{folder.name}: no pictures of any method were found")
    return PaperScene(folder.name, "syncom", folders=folders, files=files, results=results, taken=tuple(taken))


def _pictures(root: Path, folder: Path) -> tuple[dict[str, Path], list[str]]:
    folders: dict[str, Path] = {}
    taken: list[str] = []
    for one in sorted(picture_folders(folder), key=lambda item: (len(item.parts), item.parts)):
        where = from_root(one.path, root)
        role = "truth" if one.parts == (_PICTURES,) else one.role
        if role is None or role in folders:
            taken.append(f"{where}: not used; name it in {LAYOUT_FILE} if it shows truth, masks, background, composite")
            continue
        folders[role] = one.path
        why = "a guess: the loader reads it as the composition's pictures" if role == "truth" else "by its name"
        taken.append(f"{where}: taken for the {role} ({why})")
    if "truth" not in folders:
        taken.append("no pictures with the object really in the scene were found: only numbers that need no truth")
    return folders, taken


def _results(root: Path, name: str) -> dict[str, Path]:
    """Pictures of methods; ComGS writes frames/ beside a video."""
    found: dict[str, Path] = {}
    for method in subfolders(root / _RESULTS):
        shown = picture_folders(method / name) if (method / name).is_dir() else []
        if shown:
            found[published_name(method.name)] = shown[0].path
    return found
