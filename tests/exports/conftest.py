"""Paths of the folders with scenes and browser for the tests of exports."""

import sys
from pathlib import Path

for name in ("editor", "formats"):
    sys.path.append(str(Path(__file__).parents[1] / name))
