"""Scenes of exams that have been used: numbers are fitted on them, and networks trained."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from exam.scene_files import ExamScene, read_scene
from splatgraft.core.bounds import bounding_sphere
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.relighting.light.estimate import EstimatedLight, NoLight, fit_light
from splatgraft.runtime.console import Console

_RECONSTRUCTION = ReconstructOptions(iterations=1000, budget=20_000)
"""As an exam's."""


@dataclass(frozen=True)
class TrainingScene:
    """A rendered scene on disk."""

    name: str
    """EXAM-SCENE."""
    files: Path
    """As `render_scene` leaves them."""
    work: Path
    """Its reconstructions, object and composite."""

    def read(self) -> ExamScene:
        """The scene; it is reconstructed where that is not done yet.

        Raises:
            ValueError: A file is missing or damaged.
        """
        return read_scene(self.files, self.work, _RECONSTRUCTION, Console())


def scenes_in(folders: Sequence[Path], works: Sequence[Path]) -> list[TrainingScene]:
    """All scenes with known light in folders of exams.

    Args:
        folders: Each holds scenes.
        works: Their reconstructions, in the same order.
    """
    return [
        TrainingScene(f"{folder.resolve().parent.name}-{path.name}", path, work / path.name)
        for folder, work in zip(folders, works, strict=True)
        for path in sorted(p for p in folder.iterdir() if (p / "probe.npy").is_file())
    ]


def estimated_lights(scene: ExamScene) -> dict[str, EstimatedLight | NoLight]:
    """The estimates at the `new` and the `old` place of a scene, by nothing but its reconstructions."""
    placed, source = scene.composite.objects[0], scene.source
    new = fit_light(scene.composite.target, bounding_sphere(placed.in_target()), scene.cameras)
    old = fit_light(
        source.gaussians, bounding_sphere(placed.gaussians), source.cameras, object_gaussians=placed.gaussians
    )
    return {"new": new, "old": old}
