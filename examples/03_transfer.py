"""An object is placed in another scene, lit by it, and all views are made to agree: the whole transfer as values."""

from pathlib import Path

from splatgraft.composition import compose
from splatgraft.consolidation import consolidate
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.similarity import Similarity
from splatgraft.formats import read_capture
from splatgraft.harmonization import HarmonizerInputs, make_harmonizer
from splatgraft.reconstruction import ReconstructOptions, reconstruct
from splatgraft.relighting import SourceScene, relight
from splatgraft.rendering import render
from splatgraft.segmentation import lift_masks, select_object

DATA = Path(__file__).parents[1] / "data"


def main() -> None:
    vase_capture, room_capture = (read_capture(DATA / name).resized(0.25) for name in ("vase", "room"))
    options = ReconstructOptions(iterations=60, budget=4000)
    stage, room = reconstruct(vase_capture, options), reconstruct(room_capture, options)
    masks = [mask for index in range(len(vase_capture)) if (mask := vase_capture.mask(index)) is not None]
    selection = select_object(stage, lift_masks(stage, vase_capture.cameras, masks))

    # these two captures share world coordinates; otherwise splatgraft.composition.place_object finds a place
    composite = compose(room, [stage.select(selection)], target_from_objects=[Similarity.identity()])
    source = SourceScene(stage.select(~selection), vase_capture.cameras)
    relit = relight(composite, room_capture.cameras, sources=[source])
    print(*relit.report, sep="\n")

    scene = relit.bake()
    harmonizer = make_harmonizer("reinhard")
    views = room_capture.cameras[[0, 9, 18, 27]]
    images = [harmonizer.harmonize(view_of(scene, room, index, room_capture)).image for index in (0, 9, 18, 27)]
    result = consolidate(scene, views, images)
    changed = int((result.sh != scene.sh).flatten(1).any(1).sum())
    print(f"{result.count} Gaussians, {changed} of another colour than before")


def view_of(scene: Gaussians, room: Gaussians, index: int, capture: PosedImages) -> HarmonizerInputs:
    """What a harmoniser is given of one view; here the light prior is also the composite."""
    camera = capture.cameras[index]
    drawn = render(scene, camera, outputs=frozenset({"color", "depth", "normal"}))
    before = render(room, camera).color
    assert drawn.color is not None
    assert drawn.depth is not None
    assert drawn.normal is not None
    assert before is not None
    mask = (drawn.color - before).abs().amax(-1)[0] > 0.1
    color = drawn.color[0].clamp(0, 1)
    return HarmonizerInputs(
        composite=color,
        background=before[0].clamp(0, 1),
        mask=mask.float(),
        depth=drawn.depth[0],
        normal=drawn.normal[0],
        prior=color,
    )


if __name__ == "__main__":
    main()
