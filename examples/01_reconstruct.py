"""Reconstruct a 3DGS scene from a posed capture and render it; with few steps and small images it takes seconds."""

import tempfile
from pathlib import Path

import splatgraft as sg

DATA = Path(__file__).parents[1] / "data"


def main() -> None:
    folder = Path(tempfile.mkdtemp(prefix="splatgraft_"))
    capture = sg.read_capture(DATA / "room")
    scene = sg.reconstruct(capture, sg.ReconstructOptions(iterations=60, budget=4000, resolution=0.25))
    sg.save(folder / "scene.ply", scene)

    # any 3DGS .ply can be loaded, from here or from another program
    scene = sg.load(folder / "scene.ply")
    picture = sg.render(scene, capture.cameras[0]).color[0]
    sg.save_image(folder / "view.png", picture)
    print(f"{scene.count} Gaussians; {folder / 'view.png'}")


if __name__ == "__main__":
    main()
