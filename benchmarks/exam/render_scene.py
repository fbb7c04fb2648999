"""One scene of an exam, rendered by Blender and laid out as captures with its true lights; continued after a kill."""

from pathlib import Path

from exam.draw import SIZE
from splatgraft.runtime.workers import run_tasks
from splatgraft_paper.benchmark.true_light_file import TRUE_LIGHT_FILE, write_true_light
from splatgraft_paper.synthesis.benchmark import BenchmarkScene, find_defect, gather, plan
from splatgraft_paper.synthesis.jobs import render_tasks


def render_scene(which: BenchmarkScene, out: Path, blender_python: Path, *, jobs: int) -> Path:
    """Render what is missing of a scene.

    Args:
        which: The scene.
        out: Folder of the exam; receives renders/ and scenes/.
        blender_python: A Python with bpy.
        jobs: Blender processes at a time.

    Returns:
        The scene's folder, as `synth benchmark` lays it out.

    Raises:
        ValueError: Blender fails, or a picture is black, clipped or without the object.
    """
    folder = out / "scenes" / which.name
    if not (folder / TRUE_LIGHT_FILE).is_file():  # it is written last
        sides = [out / "renders" / f"{which.name}_{side}" for side in ("target", "source")]
        planned = list(zip(plan(which, SIZE), sides, strict=True))
        if failures := run_tasks(render_tasks(planned, blender_python), at_once=jobs):
            raise ValueError(failures[0])
        gather(which, sides[0], sides[1], folder)
        write_true_light(folder)
    if defect := find_defect(folder):
        raise ValueError(defect)
    return folder
