"""A project from Python: the steps that `splatgraft run` does, one by one, and why each is stale or not."""

import tempfile
from pathlib import Path

from splatgraft.project.record import why_stale
from splatgraft.project.step import job_of, perform
from splatgraft.runtime.console import Console
from splatgraft.workflow.flow import read_flow

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
"""


def main() -> None:
    folder = Path(tempfile.mkdtemp(prefix="splatgraft_"))
    (folder / "project.toml").write_text(PROJECT)
    flow = read_flow(folder)
    for name, step in flow.up_to("segment").items():
        print(f"{name}: {why_stale(job_of(step))}")
        perform(step, Console(), name=name)
        assert why_stale(job_of(step)) is None
    print(f"the object: {flow.steps['segment'].out / 'object.ply'}")


if __name__ == "__main__":
    main()
