"""The child process that says which steps of a project are stale, for the start page of `edit`.

Reads the path of a project file per line, in JSON, and answers with a JSON object per line: for each step why it is
stale, or null; an entry `error` where the project cannot be read. Ends with its input. Not a command.
"""

import json
import sys
from pathlib import Path


def main(out: Path | None) -> int:
    """Answer until the input ends.

    Args:
        out: Folder of the results; None: that of each project file.
    """
    for line in sys.stdin:
        print(json.dumps(_reasons(Path(json.loads(line)), out)), flush=True)
    return 0


def _reasons(file: Path, out: Path | None) -> dict[str, str | None]:
    # torch and the steps take seconds to load
    from splatgraft.workflow.flow import read_flow, reasons

    try:
        return reasons(read_flow(file, out))
    except (ValueError, OSError, RecursionError) as error:
        return {"error": " ".join(str(error).split())}


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]) if sys.argv[1:] else None))
