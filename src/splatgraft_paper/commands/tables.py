"""The command `paper tables`: tables on the authors' data set or on SynCom, published numbers beside measured."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

from splatgraft.project.step import Device, locked
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.runtime.console import Console
from splatgraft_paper.benchmark.methods import Method, MethodSettings
from splatgraft_paper.benchmark.run import unmeasurable_metrics
from splatgraft_paper.tables.data_layout import find_layout
from splatgraft_paper.tables.our_pictures import OurRun
from splatgraft_paper.tables.paper_scene import DataLayout, Dataset
from splatgraft_paper.tables.published_datasets import PUBLISHED, download
from splatgraft_paper.tables.report import write_paper_report
from splatgraft_paper.tables.run import PaperRun, perform_paper_run

PAPERS_OWN = "off+flux/paper"
"""Our implementation of the paper's method: copy-paste, FLUX, 10,000 steps of Adam on a perceptual loss."""


@dataclass(frozen=True)
class EvaluatePaper:
    """Measure the authors' published pictures, run ours on their scenes, and write the paper's tables."""

    data: Path
    """Folder of the published data set (the one that holds data_3d/ or dot3d_data/; of SynCom composition/)."""
    out: Path = Path("paper")
    """Folder for index.html, paper.md, paper.json, figures/, layout.toml and all results."""
    dataset: Dataset = "dot3d"
    """Whose data set it is: the authors' (dot3d), or that of ComGS (syncom)."""
    measure_only: bool = False
    """Measure the pictures that are there, and run nothing: needs no GPU and no weights."""
    methods: tuple[str, ...] = (
        "copy-paste", "transfer", PAPERS_OWN, "off+flux/l1-dssim", f"{PAPERS_OWN}@linear", f"{PAPERS_OWN}@geometric",
    )  # fmt: skip
    """Methods of ours to run, as `evaluate benchmark` names them; off+flux/paper is the paper's own."""
    only: tuple[str, ...] = ()
    """Names of scenes; all where none is given."""
    layout: Path | None = None
    """A layout.toml that corrects what was taken for what; DATA/layout.toml where there is one."""
    all_views: bool = False
    """Measure all views, not only the held-out ones."""
    download: bool = False
    """Fetch the data set into the folder first."""
    weights: Path | None = None
    """Folder with the weights of LPIPS and Inception; torch hub's cache where not given."""
    harmonizer_weights: str | None = None
    """Weights of the image model that the methods name: folder, file or hub id, as `harmonize --weights` takes them."""
    iterations_of_consolidation: int = 10_000
    """Steps of the paper's consolidation."""
    options: ReconstructOptions = field(default_factory=lambda: ReconstructOptions(quality="draft", device="auto"))

    def execute(self, console: Console) -> int:
        """Measure and run what is missing and write the tables; 1 where a method that was asked for could not run."""
        if self.download:
            download(PUBLISHED[self.dataset], self.data)
        layout = self._chosen(find_layout(self.data, self.layout, dataset=self.dataset))
        missing_metrics = unmeasurable_metrics(self.weights)
        for name, reason in missing_metrics.items():
            console.say(f"{name}: not measured: {reason}")
        methods = tuple(Method.parse(text) for text in self.methods)
        settings = MethodSettings(
            self.weights, self.harmonizer_weights, cast(Device, self.options.device), self.iterations_of_consolidation
        )
        run = PaperRun(
            OurRun(self.out, self.options, settings, layout.held_out_every),
            layout,
            methods,
            measure_only=self.measure_only,
            all_views=self.all_views,
        )
        with locked(self.out):
            found = perform_paper_run(run, missing_metrics, console)
            page = write_paper_report(self.out, found)
        console.result(page)
        failed = not self.measure_only and any(method in found.ours for _, method in found.missing)
        return 1 if failed else 0

    def _chosen(self, layout: DataLayout) -> DataLayout:
        names = [scene.name for scene in layout.scenes]
        if unknown := [name for name in self.only if name not in names]:
            raise ValueError(f"--only: expected names among {', '.join(names)}; found {unknown[0]}")
        return replace(layout, scenes=tuple(s for s in layout.scenes if not self.only or s.name in self.only))
