"""What helps most where a step was unsure of its result: one command or one click, by the step's name."""

from pathlib import Path

from splatgraft.runtime.help_link import help_link

_REMEDIES = {
    "capture": "add or replace the photos named, or take more, sharper and with more overlap: splatgraft check PHOTOS",
    "reconstruct": "leave the named photos out, or lock exposure and photograph again: splatgraft check PHOTOS",
    "segment": "put the box around the object, or paint what is missing: splatgraft edit {folder}, step Select",
    "compose": "drag the object to where it should stand and press Drop: splatgraft edit {folder}, step Place",
    "relight": "turn the arrow of the light to where it comes from: splatgraft edit {folder}, step Light",
}


def remedy(step: str, folder: Path) -> str | None:
    """What helps most against the doubts of a step; None where nothing is known to.

    Args:
        step: The command, e.g. "compose".
        folder: Of the project.
    """
    found = _REMEDIES.get(step)
    return None if found is None else found.format(folder=folder)


def step_help_link(step: str) -> str:
    """The page and section that explain the messages of a step."""
    return help_link(f"splatgraft.commands.steps.{step}")
