"""The value `Note`: what a stage or a step has to say of its result."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class Note:
    """One message on a result: a stage returns notes, and a step hands them to `Console.tell`."""

    text: str
    """One or more sentences without line breaks."""
    level: Literal["said", "minor", "warning"] = "said"
    """said: a fact; minor: something was amiss and the step did what was needed; warning: the result is in doubt."""
    remedy: str = ""
    """What the user can do about it, a sentence; empty where nothing is known to help."""
    picture: Path | None = None
    """An image that shows it: in the folder that the step writes, or a photo."""

    @property
    def in_doubt(self) -> bool:
        """Whether the result may be wrong."""
        return self.level == "warning"
