"""Starts the program: `python FOLDER JOB`, without the package that the folder lies in."""

import json
import sys
from importlib import import_module
from pathlib import Path

if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).resolve().parents[1])
    import_module("colmap_process.mapping").main(json.loads(sys.argv[1]))
