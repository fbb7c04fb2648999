"""A posed capture becomes a 3DGS scene, and the scene a picture. Takes seconds: few steps, small images."""

import tempfile
from pathlib import Path

from splatgraft.core.images import write_image
from splatgraft.formats import read_capture, read_gaussians, write_gaussians
from splatgraft.reconstruction import ReconstructOptions, reconstruct
from splatgraft.rendering import render

DATA = Path(__file__).parents[1] / "data"


def main() -> None:
    folder = Path(tempfile.mkdtemp(prefix="splatgraft_"))
    capture = read_capture(DATA / "room")
    options = ReconstructOptions(iterations=60, budget=4000, resolution=0.25)
    scene = reconstruct(capture, options, progress=lambda done, total, text: None)
    write_gaussians(folder / "scene.ply", scene)

    # any 3DGS .ply can be read back, from here or from another program
    scene = read_gaussians(folder / "scene.ply")
    picture = render(scene, capture.cameras[0]).color
    assert picture is not None
    write_image(folder / "view.png", picture[0])
    print(f"{scene.count} Gaussians; {folder / 'view.png'}")


if __name__ == "__main__":
    main()
