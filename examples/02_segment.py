"""2D masks are lifted to the Gaussians of an object, which is then taken out of its scene."""

from pathlib import Path

from splatgraft.formats import read_capture
from splatgraft.reconstruction import ReconstructOptions, reconstruct
from splatgraft.segmentation import lift_masks, select_object

DATA = Path(__file__).parents[1] / "data"


def main() -> None:
    capture = read_capture(DATA / "vase").resized(0.25)
    scene = reconstruct(capture, ReconstructOptions(iterations=60, budget=4000))
    masks = [mask for index in range(len(capture)) if (mask := capture.mask(index)) is not None]

    # one number per Gaussian: the share of what it contributes to pictures that falls inside the masks
    feature = lift_masks(scene, capture.cameras, masks)
    selection = select_object(scene, feature)
    vase, stage = scene.select(selection), scene.select(~selection)
    print(f"the vase: {vase.count} Gaussians; the stage without it: {stage.count}")


if __name__ == "__main__":
    main()
