"""Run the steps of a project from Python, up to one of them, and list stale steps with reasons."""

import tempfile
from pathlib import Path

import splatgraft as sg

DATA = Path(__file__).parents[1] / "data"
PROJECT = f"""
[source]
capture = {str(DATA / "vase")!r}
[target]
capture = {str(DATA / "room")!r}
[reconstruct]
iterations = 40
budget = 3000
resolution = 0.25
[segment]
solidify = 40
"""


def main() -> None:
    project = Path(tempfile.mkdtemp(prefix="splatgraft_")) / "project.toml"
    project.write_text(PROJECT, encoding="utf-8")
    folders = sg.run_project(project, to="segment")
    print(f"the object: {sg.load(folders['segment'] / 'object.ply').count} Gaussians in {folders['segment']}")
    print("still to do:", sg.stale_steps(project))

    # a changed option makes the steps that depend on it stale; the next run repeats them
    project.write_text(PROJECT.replace("solidify = 40", "solidify = 0"), encoding="utf-8")
    print("stale now:", sg.stale_steps(project)["segment"])


if __name__ == "__main__":
    main()
