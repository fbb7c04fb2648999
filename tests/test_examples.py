"""The examples run unchanged and without warnings; the notebook runs on small photos, and its cells show pictures."""

import base64
import io
import runpy
from pathlib import Path

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient
from PIL import Image

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("[0-9]*.py"))
LONG = ("02_segment", "03_transfer", "04_project", "05_several_objects")


@pytest.mark.parametrize(
    "example", [pytest.param(one, id=one.stem, marks=pytest.mark.long if one.stem in LONG else ()) for one in EXAMPLES]
)
def test_an_example_runs(example: Path) -> None:
    runpy.run_path(str(example), run_name="__main__")


@pytest.mark.long
def test_the_notebook_runs_and_shows_pictures(tmp_path: Path) -> None:
    notebook = nbformat.read(EXAMPLES[0].with_name("splatgraft.ipynb"), as_version=4)
    (settings,) = (cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", []))
    settings.source = "quality, size = sg.ReconstructOptions(iterations=60, budget=3000), 0.25"
    NotebookClient(notebook, timeout=None, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    pictures = [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(output.data["image/png"]))).convert("RGB"))
        for output in outputs
        if "image/png" in output.get("data", {})
    ]
    # photos, result, light, a move, another light, the loaded scene, the transfer into it
    assert len(pictures) == 7
    # no picture is empty: its brightness varies by more than noise of 8 bits
    assert min(float(picture.std()) for picture in pictures) > 5
    (result, moved, evening) = (pictures[i].astype(float) for i in (1, 3, 4))
    assert np.abs(moved - result).max() > 50
    assert np.abs(evening - result).max() > 50
    frames = [text for output in outputs if "<iframe" in (text := output.get("data", {}).get("text/html", ""))]
    assert len(frames) == 1
    assert "Before" in frames[0]
    for name in ("table.ply", "bananas_on_a_table.ply", "bananas_on_a_table.html", "bananas_on_a_table.png"):
        assert (tmp_path / name).stat().st_size > 1000
