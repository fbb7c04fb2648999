"""Published data sets with ground truth: the authors' data set and SynCom, downloaded on request.

Untested on the data itself: the layout follows the documented folder names. Folders inside a scene are searched by the
usual names listed here, and an error names those that are not found.
"""

from dataclasses import dataclass
from pathlib import Path

from splatgraft.formats import read_capture


@dataclass(frozen=True)
class PublishedLayout:
    """The folder layout of one published data set."""

    repository: str
    """On Hugging Face."""
    parts: tuple[str, ...]
    """Folders that hold one folder per scene, relative to the data set."""
    source: tuple[str, ...] = ("source", "object", "src")
    """Possible folder names of the capture of the object, in a scene's folder."""
    target: tuple[str, ...] = ("target", "background", "scene", "tgt")
    """Possible folder names of the capture without the object."""
    truth: tuple[str, ...] = ("ground_truth", "gt", "harmonized", "composite_gt")
    """Possible folder names of the capture with the object."""
    masks: tuple[str, ...] = ("masks", "mask")
    """Possible names of the folder of object masks in the truth."""
    results: str = ""
    """Folder with the authors' own results, one folder of pictures per method; empty where there is none."""


DOT3D = PublishedLayout(
    repository="nviolante/dot3d",
    parts=("data_3d/synthetic/insertions", "data_3d/real/insertions", "data_rotation"),
    results="results",
)
SYNCOM = PublishedLayout(repository="yGaoJiany/SynCom", parts=("", "data", "test"))
PUBLISHED = {"dot3d": DOT3D, "syncom": SYNCOM}


@dataclass(frozen=True)
class PublishedScene:
    """One scene of a published data set."""

    name: str
    """Its folder's name."""
    source: Path
    """The capture of the object."""
    target: Path
    """The capture of the target without the object."""
    truth: Path | None
    """The capture with the object; None for real scenes, which have none."""


def download(layout: PublishedLayout, folder: Path, *, parts: tuple[str, ...] | None = None) -> Path:
    """Download parts of a data set from Hugging Face into `folder`; existing files are kept.

    Args:
        layout: of the data set.
        folder: receives the files.
        parts: folders to download; those of `layout` where None.

    Raises:
        ModuleNotFoundError: huggingface_hub is not installed.
        ValueError: the data set cannot be reached.
    """
    import huggingface_hub

    patterns = [f"{part}/**" if part else "**" for part in (parts or layout.parts)]
    try:
        huggingface_hub.snapshot_download(
            layout.repository, repo_type="dataset", local_dir=str(folder), allow_patterns=patterns
        )
    except (OSError, ValueError, huggingface_hub.errors.HfHubHTTPError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(
            f"https://huggingface.co/datasets/{layout.repository}: expected to fetch {', '.join(patterns)}, "
            f"found {type(error).__name__}: {reason}"
        ) from error
    return folder


def find_scenes(layout: PublishedLayout, folder: Path) -> list[PublishedScene]:
    """List all scenes of a downloaded data set.

    Raises:
        ValueError: none is found, or a scene lacks its source or target.
    """
    found = []
    for part in layout.parts:
        base = folder / part
        for scene in sorted(path for path in base.iterdir() if path.is_dir()) if base.is_dir() else ():
            if any((scene / name).is_dir() for name in (*layout.source, *layout.target)):
                found.append(_scene(layout, scene))
    if not found:
        expected = ", ".join(f"{part or '.'}/SCENE/{{{','.join(layout.source)}}}" for part in layout.parts)
        raise ValueError(f"{folder}: expected {layout.repository} with {expected}; found no such folder")
    return found


def _scene(layout: PublishedLayout, scene: Path) -> PublishedScene:
    places = {}
    for role in ("source", "target", "truth"):
        names = getattr(layout, role)
        places[role] = next((scene / name for name in names if (scene / name).is_dir()), None)
        if places[role] is None and role != "truth":
            raise ValueError(f"{scene}: expected the {role} in a folder named {', '.join(names)}; found none")
        if places[role] is not None:
            read_capture(places[role])
    return PublishedScene(scene.name, places["source"], places["target"], places["truth"])


def method_pictures(layout: PublishedLayout, folder: Path) -> dict[str, Path]:
    """Find the authors' own results.

    Returns:
        Method to the folder that holds one folder of pictures per scene.

    Raises:
        ValueError: the data set has none.
    """
    base = folder / layout.results
    methods = sorted(path for path in base.iterdir() if path.is_dir()) if layout.results and base.is_dir() else []
    if not methods:
        raise ValueError(f"{base}: expected one folder per method, found none")
    return {path.name: path for path in methods}
