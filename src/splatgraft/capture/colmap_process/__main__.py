"""Start the program as `python FOLDER JOB`, without importing the package around this folder."""

import json
import sys
from importlib import import_module
from pathlib import Path

if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).resolve().parents[1])
    import_module("colmap_process.mapping").main(json.loads(sys.argv[1]))
