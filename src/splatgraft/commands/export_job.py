"""The child process of the editor's exports: the command `export`, with its progress written to a state file.

Started as `python -m splatgraft.commands.export_job FOLDER TITLE SCENE FILE PAGE LAYER`; not a command.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import cast

from splatgraft.workflow.background_job import JobConsole, run_as_job


def export_words(scene: Path, to: Path, *, page: str, layer: str) -> tuple[str, ...]:
    """The words of the equivalent command, after `splatgraft`; defaults are left out."""
    part = () if layer == "all" else ("--layer", layer)
    return ("export", str(scene), "--to", str(to), *(("--page", "report") if page == "report" else part))


def main(arguments: Sequence[str]) -> int:
    """Write the file; the outcome is in the state file and the exit status."""
    folder, title, scene, to, page, layer = arguments

    def work(console: JobConsole) -> Sequence[str]:
        from splatgraft.commands.export import Export
        from splatgraft.exports.export import ExportOptions, Layer

        options = ExportOptions(layer=cast("Layer", layer))
        return Export(Path(scene), Path(to), "report" if page == "report" else "viewer", options=options).write(console)

    shown = export_words(Path(scene), Path(to), page=page, layer=layer)
    return run_as_job(Path(folder), title, shown, work)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
