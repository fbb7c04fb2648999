"""A composition of SynCom as one of our scenes with ground truth: captures and placement in our files."""

from dataclasses import dataclass
from pathlib import Path

from splatgraft.core.posed_images import PosedImages
from splatgraft.formats import read_capture, write_cameras, write_capture
from splatgraft.formats.placement import ObjectPlacement, Placement, write_placement
from splatgraft.project.layout import PLACEMENT_FILE
from splatgraft_paper.benchmark.scene import GroundTruthScene
from splatgraft_paper.tables import syncom_json
from splatgraft_paper.tables.paper_scene import LAYOUT_FILE, PaperScene
from splatgraft_paper.tables.syncom_folders import object_of

_NEEDED = ("source_capture", "target_capture", "placement", "cameras")


@dataclass(frozen=True)
class ConvertedScene:
    """A composition in our files."""

    truth: GroundTruthScene
    cameras: Path
    """transforms.json of the measured views."""


def convert_syncom(scene: PaperScene, out: Path) -> ConvertedScene:
    """Write captures, cameras and placement of a composition in our formats; pictures are referenced.

    Args:
        scene: Of kind syncom.
        out: Folder for source/, target/, cameras.json and placement.json.

    Raises:
        ValueError: A part is missing or broken, or the composition has not exactly one object.
    """
    name = object_of(scene.name)
    missing = [key for key in _NEEDED if key not in scene.files] + ([] if "truth" in scene.folders else ["truth"])
    if missing or name is None:
        found = f"no {', '.join(missing)}" if missing else "another name"
        raise ValueError(f"{scene.name}: expected SCENE_with_OBJECT with {', '.join(_NEEDED)} and truth, "
                         f"found {found}; name them in {LAYOUT_FILE}")  # fmt: skip
    for side in ("source", "target"):
        (out / side).mkdir(parents=True, exist_ok=True)
        write_capture(out / side, _capture(scene.files[f"{side}_capture"]))
    placement, cameras = out / PLACEMENT_FILE, out / "cameras.json"
    write_placement(
        placement, Placement((ObjectPlacement(syncom_json.read_transform(scene.files["placement"], name)),))
    )
    write_cameras(cameras, syncom_json.read_cameras(scene.files["cameras"]))
    captures = (out / "source", out / "target")
    # the measured views are those of the composition: a method is given every view of the empty scene
    truth = GroundTruthScene(scene.name, *captures, scene.folders["truth"], placement, held_out_every=None)
    return ConvertedScene(truth, cameras)


def _capture(path: Path) -> PosedImages:
    return syncom_json.read_capture(path) if syncom_json.is_syncom_capture(path) else read_capture(path)
