"""Puts tests/commands on the path, whose tiny project the editor's tests use, and provides a browser."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "commands"))
