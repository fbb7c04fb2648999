"""Puts the folders on the path whose scenes and browser the tests of exports use."""

import sys
from pathlib import Path

for name in ("editor", "formats"):
    sys.path.append(str(Path(__file__).parents[1] / name))
