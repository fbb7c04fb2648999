"""The value `Note`: one message of a stage or a step on its result."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class Note:
    """One message on a result; a stage returns notes, and a step passes them to `Console.tell`."""

    text: str
    """One or more sentences without line breaks."""
    level: Literal["said", "minor", "warning"] = "said"
    """said: a fact; minor: a fault that the step has corrected; warning: the result is in doubt."""
    remedy: str = ""
    """Advice to the user, one sentence; empty if none is known."""
    picture: Path | None = None
    """Image that shows the fault: in the folder that the step writes, or a photo."""

    @property
    def in_doubt(self) -> bool:
        """Whether the result may be wrong."""
        return self.level == "warning"
