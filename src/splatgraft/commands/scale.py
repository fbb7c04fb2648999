"""The command `scale`: the size of a capture's world unit in metres, stored with the capture."""

from dataclasses import dataclass
from pathlib import Path

from splatgraft.capture import scale_from_length, scale_from_marker
from splatgraft.folders.picture_points import point_in_world
from splatgraft.formats import read_capture, read_gaussians
from splatgraft.project.metric_scale import MetricScale, write_scale
from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.runtime.lazy_sequence import LazySequence


@dataclass(frozen=True)
class Scale:
    """Set how large a capture is, by a known length, a marker or a factor; `compose` then gives the object its size."""

    capture: Positional
    """A folder with transforms.json or a COLMAP folder; of a project: source/capture or target/capture."""
    factor: float | None = None
    """Metres in one world unit; 1 for poses in metres, such as those of ARKit."""
    length: float | None = None
    """A known length in metres, between the two points of --ends."""
    ends: tuple[str, str] | None = None
    """Two points, each "IMAGE:X,Y IMAGE:X,Y" (pixels of the same point in two or more images), "IMAGE:X,Y" with
    --scene, or "X,Y,Z" in world units."""
    scene: Path | None = None
    """The reconstruction, a .ply; points given in only one image are placed on its surface."""
    marker: float | None = None
    """Side in metres of an AprilTag or ArUco marker (its black square), visible in two or more images."""

    def execute(self, console: Console) -> int:
        """Find the scale, print it and store it."""
        found = self._found(console)
        path = write_scale(self.capture, found)
        console.say(f"{self.capture}: one unit is {found.metres_per_unit:.4g} m, by {found.source}")
        console.result(path)
        return 0

    def _found(self, console: Console) -> MetricScale:
        given = [name for name in ("factor", "length", "marker") if getattr(self, name) is not None]
        if len(given) != 1 or (self.length is None) != (self.ends is None):
            found = ", ".join(f"--{name}" for name in given) or "none"
            raise ValueError(f"scale: expected one of --factor, --marker and --length with --ends, found {found}")
        if self.factor is not None:
            if not 0 < self.factor < float("inf"):
                raise ValueError(f"--factor: expected metres above 0, found {self.factor:g}")
            return MetricScale(self.factor, "the factor that was given")
        capture = read_capture(self.capture)
        if self.marker is not None:
            if not 0 < self.marker < float("inf"):
                raise ValueError(f"--marker: expected metres above 0, found {self.marker:g}")
            images = LazySequence(len(capture), capture.image)
            with console.bar("scale") as progress:
                return scale_from_marker(images, capture.cameras, self.marker, progress=progress)
        assert self.length is not None
        assert self.ends is not None
        scene = None if self.scene is None else read_gaussians(self.scene)
        first, second = (point_in_world(text, capture, scene, option="--ends") for text in self.ends)
        return scale_from_length((first, second), self.length)


COMMAND = Scale
