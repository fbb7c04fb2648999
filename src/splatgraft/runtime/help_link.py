"""The link of an error or a warning to the part of the documentation that explains it, by the module it comes from.

The scheme: `docs/troubleshooting.md#SECTION`, relative to the repository; a site with an address of its own replaces
`PAGE`. A test compares the table below with the messages that each section lists.
"""

from collections.abc import Iterator
from types import TracebackType

PAGE = "docs/troubleshooting.md"

_PACKAGE = "splatgraft."
_SECTIONS = {
    "cli": "start-and-options",
    "project.step": "start-and-options",
    "rendering.cuda": "start-and-options",
    "workflow.flow": "start-and-options",
    "commands.init": "projecttoml",
    "commands.demo": "projecttoml",
    "commands.first_try": "projecttoml",
    "project.project_file": "projecttoml",
    "runtime.settings": "projecttoml",
    "project": "results-and-running-jobs",
    "runtime": "results-and-running-jobs",
    "runtime.weights": "weights",
    "commands.weights": "weights",
    "capture": "capture-photos-and-videos",
    "commands.check": "capture-photos-and-videos",
    "commands.steps.capture": "capture-photos-and-videos",
    "core.images": "capture-photos-and-videos",
    "folders.capture_files": "capture-photos-and-videos",
    "folders.input_description": "capture-photos-and-videos",
    "formats": "capture-photos-and-videos",
    "workflow.run_steps": "capture-photos-and-videos",
    "capture.metric_scale": "compose-and-placementjson",
    "capture.camera_positions": "capture-scenes-without-photographs",
    "capture.virtual_cameras": "capture-scenes-without-photographs",
    "core.capture_orientation": "capture-scenes-without-photographs",
    "formats.captures.given_poses": "capture-photos-and-videos",
    "formats.captures.colmap": "colmap-models",
    "core.distortion": "transformsjson-camerasjson-masks-points",
    "folders.object_masks": "transformsjson-camerasjson-masks-points",
    "formats.captures": "transformsjson-camerasjson-masks-points",
    "formats.json_file": "transformsjson-camerasjson-masks-points",
    "commands.steps.adopt": "trained-scenes",
    "core.spherical_harmonics": "trained-scenes",
    "formats.scenes": "trained-scenes",
    "commands.steps.reconstruct": "reconstruct",
    "core.image_metrics": "reconstruct",
    "fitting": "reconstruct",
    "reconstruction": "reconstruct",
    "commands.steps.segment": "segment",
    "folders.selection_file": "segment",
    "formats.gaussian_flags": "segment",
    "segmentation": "segment",
    "commands.steps.compose": "compose-and-placementjson",
    "composition": "compose-and-placementjson",
    "folders.composite_folder": "compose-and-placementjson",
    "folders.picture_points": "compose-and-placementjson",
    "formats.metric_scale": "compose-and-placementjson",
    "formats.placement": "compose-and-placementjson",
    "formats.prompts": "segment",
    "commands.steps.relight": "relight-and-lightjson",
    "relighting": "relight-and-lightjson",
    "commands.steps.harmonize": "render-and-harmonize",
    "commands.steps.render": "render-and-harmonize",
    "core.cameras": "render-and-harmonize",
    "folders.parallel_harmonization": "render-and-harmonize",
    "folders.view_folder": "render-and-harmonize",
    "harmonization": "render-and-harmonize",
    "rendering": "render-and-harmonize",
    "harmonization.flux": "flux",
    "harmonization.flux.sampling": "render-and-harmonize",
    "harmonization.peers": "other-image-models",
    "commands.steps.consolidate": "consolidate-and-evaluate",
    "commands.steps.evaluate": "consolidate-and-evaluate",
    "consolidation": "consolidate-and-evaluate",
    "evaluation": "consolidate-and-evaluate",
    "fitting.perceptual_losses": "consolidate-and-evaluate",
    "folders.evaluated_scenes": "consolidate-and-evaluate",
    "commands.scale": "compose-and-placementjson",
    "commands.export": "export",
    "exports": "export",
    "folders.export_source": "export",
    "commands.edit": "editor",
    "commands.edit_process": "editor",
    "commands.edit_project": "editor",
    "commands.edit_states": "editor",
    "editor": "editor",
    "commands.evaluate_benchmark": "synthetic-scenes-and-the-benchmark",
    "commands.evaluate_paper": "synthetic-scenes-and-the-benchmark",
    "commands.synth": "synthetic-scenes-and-the-benchmark",
    "evaluation.benchmark": "synthetic-scenes-and-the-benchmark",
    "runtime.workers": "synthetic-scenes-and-the-benchmark",
    "synthesis": "synthetic-scenes-and-the-benchmark",
    "workflow": "synthetic-scenes-and-the-benchmark",
    "commands.synth.orida": "training",
    "commands.synth.pack": "training",
    "commands.train": "training",
    "training": "training",
    "training.removal_objective": "flux",
    "workflow.flux_training": "training",
    "workflow.training_data": "training",
    "workflow.training_recipe": "training",
}
"""Section of the page by package or module; the longest name that fits counts."""
_DEFAULT = "start-and-options"


def help_link(module: str) -> str:
    """The page and section that explain messages of a module.

    Args:
        module: Its full name, e.g. `splatgraft.commands.steps.compose`.
    """
    return f"{PAGE}#{_section(module) or _DEFAULT}"


def help_link_of(error: BaseException) -> str:
    """The page and section that explain an error: those of the innermost function of this package that it passed."""
    sections = [_section(name) for name in _modules(error.__traceback__)]
    return f"{PAGE}#{next((found for found in reversed(sections) if found), _DEFAULT)}"


def _section(module: str) -> str | None:
    name = module.removeprefix(_PACKAGE) if module.startswith(_PACKAGE) else ""
    while name and name not in _SECTIONS:
        name = name.rpartition(".")[0]
    return _SECTIONS.get(name)


def _modules(traceback: TracebackType | None) -> Iterator[str]:
    while traceback is not None:
        yield traceback.tb_frame.f_globals.get("__name__", "")
        traceback = traceback.tb_next
