"""Points that are clicked in photos: where a click lies in the file, and the file of points that `segment` reads."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from test_hostile_values import made, project, session

from splatgraft.core.images import read_upright
from splatgraft.core.prompts import ViewPrompt
from splatgraft.editor.session.photo_points import PhotoView, prompt_of, with_click
from splatgraft.editor.session.session import Session
from splatgraft.editor.session.state_files import read_state
from splatgraft.project.toml_edit import with_keys
from splatgraft.formats.prompts import read_prompts

__all__ = ["made", "project", "session"]


@pytest.mark.parametrize("canvas", [(800, 300), (300, 800), (640, 480)])
def test_a_click_on_a_drawn_point_is_that_point(canvas: tuple[int, int]) -> None:
    view = PhotoView((320, 200), canvas)
    prompt = ViewPrompt(inside=torch.tensor([[250.0, 40.0]]))
    drawn = view.drawn(np.full((100, 160, 3), 128, np.uint8), prompt).astype(int)
    assert drawn.shape == (canvas[1], canvas[0], 3)
    rows, columns = ((drawn[..., 1] > 180) & (drawn[..., 0] < 120)).nonzero()
    found = view.pixel_at(((columns.mean() + 0.5) / canvas[0], (rows.mean() + 0.5) / canvas[1]))
    # to a pixel of the canvas
    assert found == pytest.approx((250, 40), abs=1.5 / view.scale)
    # the canvas is larger than the photo on one pair of sides, unless it has its shape
    assert view.pixel_at((0.5, 0.5)) == pytest.approx((160, 100))
    if canvas == (800, 300):
        assert view.pixel_at((0.01, 0.5)) is None
    if canvas == (300, 800):
        assert view.pixel_at((0.5, 0.99)) is None


def test_a_photo_is_shown_upright_with_its_own_size(tmp_path: Path) -> None:
    pixels = np.zeros((60, 100, 3), np.uint8)
    pixels[:, :50, 0] = 255
    tags = Image.Exif()
    tags[274] = 6  # the camera was turned: a viewer turns the picture by 90 degrees to the right
    Image.fromarray(pixels).save(tmp_path / "a.png", exif=tags)
    found, size = read_upright(tmp_path / "a.png", 50)
    assert size == (60, 100)
    assert found.shape == (50, 30, 3)
    # what was left is above now
    assert found[:20, :, 0].min() > 250
    assert found[30:, :, 0].max() < 5


def test_clicks_add_and_remove_points() -> None:
    one = with_click(None, "a/b.jpg", (10.04, 20.0), on_object=True, longer_side=1000)
    two = with_click(one, "a/b.jpg", (500.0, 20.0), on_object=False, longer_side=1000)
    assert prompt_of(two, "a/b.jpg").inside[0].tolist() == pytest.approx([10.0, 20.0])
    assert len(prompt_of(two, "a/b.jpg").outside) == 1
    # near an existing one, of either kind
    three = with_click(two, "a/b.jpg", (495.0, 25.0), on_object=True, longer_side=1000)
    assert len(prompt_of(three, "a/b.jpg").outside) == 0
    assert with_click(one, "a/b.jpg", (11.0, 19.0), on_object=False, longer_side=1000) is None
    # a file by hand may call the photo by its stem, and has a rectangle
    by_hand = {"b": ViewPrompt(inside=torch.tensor([[1.0, 2.0]]), box=(0.0, 0.0, 9.0, 9.0))}
    kept = with_click(by_hand, "a/b.jpg", (2.0, 2.0), on_object=True, longer_side=1000)
    assert kept is not None
    assert list(kept) == ["b"]
    assert kept["b"].box == (0.0, 0.0, 9.0, 9.0)


def test_points_are_saved_for_segment_and_undone(session: Session) -> None:
    project = session.files.file
    before = project.read_text()
    points = with_click(None, "a.jpg", (10.5, 20.25), on_object=True, longer_side=1000)
    session.change(replace(session.state, prompts=points))
    assert 'prompts = "prompts.json"' in project.read_text()
    stored = read_prompts(project.parent / "prompts.json")
    assert points is not None
    assert torch.equal(stored["a.jpg"].inside, points["a.jpg"].inside)
    again = Session(session.project)
    assert again.state.prompts is not None
    assert not again.notice
    assert again.undo()
    assert again.state.prompts is None
    assert "prompts" not in project.read_text().replace(before, "")
    assert again.redo()
    assert again.state.prompts is not None
    assert torch.equal(again.state.prompts["a.jpg"].inside, points["a.jpg"].inside)


def test_a_file_of_points_by_hand_is_kept_and_continued(session: Session) -> None:
    project = session.files.file
    by_hand = project.parent / "mine.toml"
    by_hand.write_text('["a.jpg"]\nbox = [1, 2, 30, 40]\n')
    project.write_text(with_keys(project.read_text(), "segment", {"prompts": "mine.toml"}))
    assert session.reload()
    points = with_click(session.state.prompts, "b.jpg", (5.0, 5.0), on_object=False, longer_side=100)
    session.change(replace(session.state, prompts=points))
    assert 'prompts = "prompts.json"' in project.read_text()
    stored = read_prompts(project.parent / "prompts.json")
    assert stored["a.jpg"].box == (1, 2, 30, 40)
    assert len(stored["b.jpg"].outside) == 1
    assert by_hand.read_text() == '["a.jpg"]\nbox = [1, 2, 30, 40]\n'
    assert session.undo()
    found = read_state(project).prompts
    assert found is not None
    assert list(found) == ["a.jpg"]


def test_a_broken_file_of_points_is_named(session: Session) -> None:
    project = session.files.file
    project.write_text(with_keys(project.read_text(), "segment", {"prompts": "prompts.json"}))
    (project.parent / "prompts.json").write_text('{"a.jpg": {"inside": [[1]]}}')
    with pytest.raises(ValueError, match=r"prompts\.json: a\.jpg: expected inside = "):
        session.reload()
    opened = Session(session.project)
    assert "prompts.json" in (opened.notice or "")
