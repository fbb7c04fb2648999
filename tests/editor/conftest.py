"""Puts the tiny project of the steps' tests on the path: the editor is tested on it too."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "commands"))
