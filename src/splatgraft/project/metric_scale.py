"""scale.json: metres per world unit of a capture, and the source of the number.

    {"metres_per_unit": 0.21, "source": "a length of 0.3 m between two points"}

It lies in the capture's folder. If a step made the capture, it lies beside the folder, so that a new run keeps it. The
step may write another one into the folder, from a file that states its size. This one is read if the first is missing.
"""

from dataclasses import asdict, dataclass
from pathlib import Path

from splatgraft.formats.json_file import excerpt, load, number, save

SCALE_FILE = "scale.json"


@dataclass(frozen=True)
class MetricScale:
    """The size of a capture's world unit."""

    metres_per_unit: float
    """Metres per world unit, above 0."""
    source: str
    """Source of the number, for messages."""


def scale_path(capture: Path) -> Path:
    """Return the path of a capture's scale; `capture` is its folder, or a file in it such as transforms.json."""
    folder = capture if capture.is_dir() else capture.parent
    return (folder.parent if (folder / "step.json").is_file() else folder) / SCALE_FILE


def find_scale(capture: Path) -> Path | None:
    """Find the scale of a capture, the user's or else the step's; None if it has none."""
    folder = capture if capture.is_dir() else capture.parent
    return next((path for path in (scale_path(capture), folder / SCALE_FILE) if path.is_file()), None)


def read_scale(capture: Path) -> MetricScale | None:
    """Read the scale of a capture; None if it has none."""
    path = find_scale(capture)
    if path is None:
        return None
    content = load(path)
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected an object with metres_per_unit, found {excerpt(content)}")
    metres = number(path, content, "metres_per_unit")
    if not metres > 0:
        raise ValueError(f"{path}: expected metres_per_unit above 0, found {metres:g}")
    return MetricScale(metres, str(content.get("source", "scale.json")))


def true_scale(source: MetricScale | None, target: MetricScale | None) -> float | None:
    """Return the size in the target over that in the source that keeps the true size; None if a scale is unknown."""
    return None if source is None or target is None else source.metres_per_unit / target.metres_per_unit


def write_scale(capture: Path, scale: MetricScale) -> Path:
    """Write the scale of a capture; returns the file.

    A step that makes the folder `capture` writes it inside, because step.json is written last.
    """
    path = scale_path(capture)
    save(path, asdict(scale))
    return path
