"""The command `synth pack`: training pairs in a few tar files instead of many pictures."""

from dataclasses import dataclass
from pathlib import Path

from splatgraft.project.folder_lock import locked
from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft_paper.training.sources.packed_pairs import INDEX_FILE, pack_pairs
from splatgraft_paper.training.sources.pair_files import FilePairs
from splatgraft_paper.training.sources.relit_pairs import RelitPairs
from splatgraft_paper.training.sources.rendered_pairs import RenderedPairs


@dataclass(frozen=True)
class PackPairs:
    """Pack folders of pairs into tar files that `train` reads from a disk or from object storage."""

    out: Positional
    """New folder for pairs-NUMBER.tar and index.jsonl."""
    pairs: tuple[Path, ...] = ()
    """Folders that `splatgraft synth pairs` rendered."""
    generated: tuple[Path, ...] = ()
    """Folders that `splatgraft synth generated`, `synth orida` or `synth spheres` made."""
    shard_mb: int = 500
    """A tar file is closed when it is larger, MB."""

    def execute(self, console: Console) -> int:
        """Write the tar files, and then their index."""
        sources: list[FilePairs] = [RenderedPairs(folder) for folder in self.pairs]
        sources += [RelitPairs(folder) for folder in self.generated]
        if not sources:
            raise ValueError("synth pack: expected --pairs or --generated, found none")
        self.out.mkdir(parents=True, exist_ok=True)
        with locked(self.out), console.bar("pack") as progress:
            count = pack_pairs(sources, self.out, shard_bytes=self.shard_mb * 1_000_000, progress=progress)
        console.say(f"{count} pairs in {len(list(self.out.glob('*.tar')))} tar files")
        console.result(self.out / INDEX_FILE)
        return 0


COMMAND = PackPairs
