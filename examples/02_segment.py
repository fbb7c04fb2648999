"""Take an object out of its scene by its 2D masks."""

from pathlib import Path

import splatgraft as sg

DATA = Path(__file__).parents[1] / "data"


def main() -> None:
    capture = sg.read_capture(DATA / "vase").resized(0.25)
    scene = sg.reconstruct(capture, sg.ReconstructOptions(iterations=60, budget=4000))

    cut = sg.segment(scene, capture, solidify=sg.SolidifyOptions(iterations=40))
    print(f"the vase: {cut.object.count} Gaussians; its surroundings: {cut.surroundings.count}")
    # the share of each Gaussian's blending weight that falls inside the masks
    inside, outside = (float(cut.feature[which].mean()) for which in (cut.selection, ~cut.selection))
    print(f"mean feature of the vase {inside:.2f}, of the rest {outside:.2f}")


if __name__ == "__main__":
    main()
