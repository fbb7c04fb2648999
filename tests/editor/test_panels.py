"""The panels without a browser: the real server and editor, with the messages that a browser would send."""

import html
import math
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from editor_pages import AROUND_THE_BALL, TOKEN, Client, opened_editor
from waiting import wait_until

from splatgraft.cli import main
from splatgraft.editor.editor import Editor
from splatgraft.editor.project import Project
from splatgraft.editor.relit_preview import RelitPreview
from splatgraft.editor.session import Session
from splatgraft.editor.state import read_state
from splatgraft.project.metric_scale import MetricScale, read_scale, true_scale, write_scale
from splatgraft.project.toml_edit import with_keys
from splatgraft.relighting import LayerWeights


def test_a_typed_box_is_saved_and_impossible_values_are_refused(editor: Editor, window: Client) -> None:
    session = editor.require_session()
    window.step("Select")
    assert (*window.control("box_from")["value"], *window.control("box_to")["value"]) == tuple(AROUND_THE_BALL)
    window.do("box_from", [-0.3, -0.35, 0.03])
    window.wait(lambda: window.control("box_from")["value"] == [-0.3, -0.35, 0.03], what="the typed box")
    assert read_state(session.files.file).box == (-0.3, -0.35, 0.03, 0.35, 0.35, 0.65)
    window.do("box_from", [9.0, -0.35, 0.03])
    window.says("expected lower < upper")
    assert window.control("box_from")["value"] == [-0.3, -0.35, 0.03]
    # what the page cannot send changes nothing either
    for value in ([1.0], "x", None, [math.nan, 0, 0], [True, 0, 0], {}):
        if value != [math.nan, 0, 0]:
            window.do("box_from", value)
    window.send("key", key="ctrl+z")
    window.wait(lambda: window.control("box_from")["value"] == AROUND_THE_BALL[:3], what="the box before")


def test_numbers_of_a_placement(editor: Editor, window: Client) -> None:
    session = editor.require_session()
    before = session.objects()[0].target_from_object
    x, y, z = window.control("position")["value"]
    window.do("position", [x + 0.1, y, z])
    window.wait(lambda: window.control("position")["value"][0] == pytest.approx(x + 0.1), what="the moved object")
    moved = session.objects()[0].target_from_object.translation - before.translation
    assert moved.tolist() == pytest.approx([0.1, 0, 0], abs=1e-5)  # float32
    scale = window.control("scale")["value"]
    for value in (0.0, -2.0, 1e300):
        window.do("scale", [value])
        window.says("expected a number")
        assert window.control("scale")["value"] == scale
        window.send("key", key="escape")
        window.wait(lambda: not window.panel["status"], what="the end of the message")
    Session(Project(session.files.file))


def test_the_object_s_height_is_shown_and_typed_in_centimetres(editor: Editor, window: Client) -> None:
    session = editor.require_session()
    before, base = session.objects()[0].target_from_object, session.placeable_object(0).base
    # without scales the page says how to get them
    assert not window.has("height")
    assert "0.8 times its size in its photos" in window.texts()
    window.do("scale", [1.0])
    window.says("type the object's true height")
    window.send("key", key="ctrl+z")
    window.says("undone")
    window.do("known", [-1.0])
    for which in ("Scale of its photos", "Scale of the place"):
        window.do("sets", which)
        window.says("height in cm: expected a number from")
    assert read_scale(session.files.cameras["source"]) is None
    assert read_scale(session.files.cameras["target"]) is None
    window.do("known", [12.0])
    window.do("sets", "Scale of the place")
    window.wait(lambda: window.has("height"), what="the height")
    found = read_scale(session.files.cameras["target"])
    assert found is not None
    assert found.metres_per_unit == pytest.approx(0.12 / (before.scale * base.height))
    assert window.control("height")["value"] == pytest.approx([12.0])
    # a typed height changes the scale, and the foot stays
    window.do("height", [18.0])
    window.wait(lambda: window.control("height")["value"] == [18.0], what="the typed height")
    after = session.objects()[0].target_from_object
    assert after.scale == pytest.approx(1.5 * before.scale)
    assert after.points(base.point).tolist() == pytest.approx(before.points(base.point).tolist(), abs=1e-5)
    # with the other scale the object gets its true size
    window.do("known", [24.0])
    window.do("sets", "Scale of its photos")
    window.says("24 cm tall")
    assert session.objects()[0].target_from_object.scale == pytest.approx(2.0 * before.scale)
    scales = (read_scale(session.files.cameras[side]) for side in ("source", "target"))
    assert true_scale(*scales) == pytest.approx(2.0 * before.scale)
    # a broken file is named, and the rest of the step stays usable
    path = write_scale(session.files.cameras["target"], MetricScale(1.0, "a test"))
    path.write_text("{")
    editor.refresh()
    window.says(str(path))
    assert not window.has("height")


def test_objects_are_duplicated_added_by_an_upload_and_parts_of_the_target_erased(
    editor: Editor, window: Client, made: Path
) -> None:
    session = editor.require_session()
    window.do("count", "Duplicate")
    window.wait(lambda: window.has("object"), what="the second object")
    first, second = (item.target_from_object for item in session.objects())
    assert float((second.translation - first.translation)[:2].norm()) > 0.2
    assert abs(float((second.translation - first.translation)[2])) < 0.05
    assert torch.equal(first.rotation, second.rotation)
    content = (made / "project" / "object" / "object.ply").read_bytes()
    number = window.panel["window"]
    # twice the same file is one, another one of that name has a number
    for name, sent in (("../../a.ply", content), ("a.ply", content), ("a.ply", content + b" ")):
        assert window.request("POST", f"/upload?window={number}&name={name}&use=upload_object", sent)[0] == 200
    folder = session.files.file.parent / "uploads"
    assert sorted(path.name for path in folder.iterdir()) == ["a.ply", "a_2.ply"]
    assert (folder / "a.ply").read_bytes() == content
    assert [path.object_path for path in session.objects()[2:4]] == [folder / "a.ply"] * 2
    status, text = window.request("POST", f"/upload?window={number}&name=.ply&use=upload_object", b"")
    assert (status, "expected a file with a suffix" in text) == (400, True)
    # another window's number, and none, are refused
    assert window.request("POST", "/upload?window=99&name=b.ply&use=upload_object", b"x")[0] == 403
    window.do("erase_box", True)
    window.do("erase")
    window.says("erased what is in the box")
    erased = read_state(session.files.file).erased
    assert erased is not None
    assert 0 < int(erased.sum()) < len(erased)
    window.do("restore")
    window.wait(lambda: not window.has("restore"), what="all restored")
    assert read_state(session.files.file).erased is None
    while session.step(-1):
        pass
    assert len(session.objects()) == 1


def test_a_watching_window_changes_nothing_and_edits_when_the_first_is_closed(editor: Editor) -> None:
    session, first, second = editor.require_session(), Client(editor.server.port), Client(editor.server.port)
    with first.window(), second.window(size=(320, 200)):
        assert first.panel["editing"]
        assert not second.panel["editing"]
        before = session.history.at
        second.send("do", id="count", value="Delete")
        second.send("key", key="delete")
        second.send("step", to="Run")
        # it looks around by itself
        second.finished()
        seen = second.pixels
        second.send("turn", x=0.1, y=0.0)
        second.wait(
            lambda: second.pixels.shape != seen.shape or bool((second.pixels != seen).any()), what="its own view"
        )
        assert (session.history.at, editor.step) == (before, "Place")
        first.socket.close()
        second.wait(lambda: second.panel["editing"], what="its turn")
        second.do("count", "Delete")
        second.wait(lambda: not session.objects(), what="the deletion")


BAD_TABLES = [
    "[relight]\nshadow = nan\n",
    "[relight]\nshadow = [[[]]]\n",
    "[relight]\ngiven_light = 7\n",
    '[segment]\nkeep = "bogus"\n',
    '[harmonize]\nmethod = "bogus"\n',
    "segment = 7\n",
    "x = " + "[" * 20_000 + "\n",
    "\x00",
]


def test_a_bad_project_file_is_said_and_opened_by_itself_once_it_is_corrected(project: Path) -> None:
    good = with_keys(project.read_text(), "relight", {"light": "off"})
    project.write_text("[")
    with opened_editor(project) as editor, Client(editor.server.port).window() as window:
        for text in BAD_TABLES:
            project.write_text(text + good.replace("[segment]", "[other]").replace("[compose]", "[more]"))
            with editor.lock:
                editor.poll()
            assert editor.session is None, text
            assert "project.toml" in (editor.problem or "")
            assert "\n" not in (editor.problem or "")
            window.says("Correct the file")
        project.write_text(good)
        window.wait(lambda: ["Place", "●"] in window.panel["steps"], what="the corrected project")
        assert editor.problem is None


def test_erased_flags_of_another_target_leave_the_page_usable(project: Path) -> None:
    session = Session(Project(project))
    count = session.scenes.scene("target").count
    session.change(replace(session.placed_state(), erased=torch.arange(count) > 3))
    np.save(project.parent / "erased.npy", np.zeros(3, bool))
    with opened_editor(project) as editor, Client(editor.server.port).window(size=(64, 48)) as window:
        window.wait(lambda: "one flag" in window.head.get("problem", ""), what="the problem on the canvas")
        window.do("restore")
        window.wait(lambda: not window.head.get("problem"), what="a picture")
        assert read_state(project).erased is None


@pytest.mark.long
def test_a_stale_result_is_marked_with_the_button_that_renews_it(project: Path) -> None:
    project.write_text(with_keys(project.read_text(), "relight", {"light": "off"}))
    assert main(["run", str(project), "--to", "consolidate"]) == 0
    with opened_editor(project) as editor, Client(editor.server.port).window() as window:
        session = editor.require_session()
        window.step("Run")
        window.says("The result is up to date")
        window.step("Share")
        assert not window.has("stale")
        window.wait(lambda: ["Run", "✓"] in window.panel["steps"], what="the mark of what is done")
        session.change(replace(session.state, weights=LayerWeights(shadow=0.5)))
        editor.refresh()
        window.says("The result is out of date: you changed the light")
        window.wait(lambda: ["Run", "↻"] in window.panel["steps"], what="the mark of what is out of date")
        window.do("kind_of_file", "Scene, exact (.ply)")
        window.do("write")
        window.says("it is out of date (you changed the light")
        assert session.jobs._child is not None
        session.jobs._child.wait()
        assert " MB in " in window.panel["status"]
        # the window that asked gets the file
        offer = window.panel["offer"]
        assert offer["name"] == "project.ply"
        assert window.get(f"/{offer['url']}") == 200
        assert session.step(-1)
        placed = session.objects()[0].target_from_object
        session.set_placement(0, replace(placed, translation=placed.translation + 0.01))
        editor.refresh()
        window.says("out of date: you moved the object")
        window.step("Place")
        assert window.control("kind")["value"] == "With its new light"


def test_nothing_is_lost_or_hidden_where_the_disk_is_full(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project.write_text(with_keys(project.read_text(), "relight", {"light": "off"}))
    before = read_state(project)
    is_full = True
    original = Path.open

    def limited(path: Path, mode: str = "r", *args: object, **options: object) -> object:
        if is_full and "w" in mode and path.suffix in (".partial", ""):
            raise OSError(28, "No space left on device", str(path))
        return original(path, mode, *args, **options)  # pyright: ignore

    monkeypatch.setattr(Path, "open", limited)
    with opened_editor(project) as editor, Client(editor.server.port).window() as window:
        # it opens, and says that nothing can be saved
        assert ["Place", "●"] in window.panel["steps"]
        window.says("Disk full: nothing can be saved")
        assert window.panel["saved"] == "not saved"
        window.do("scale", [0.5])
        window.says("Disk full: nothing can be saved")
        assert window.panel["bad"]
        assert (before.objects, read_state(project).objects) == (None, None)
        is_full = False
        window.wait(lambda: window.panel["saved"] == "saved", what="the end of the message")
        window.do("scale", [0.5])
        window.wait(lambda: window.control("scale")["value"] == [0.5], what="the change")
        is_full = True
        window.do("scale", [0.7])
        window.says("Disk full: nothing can be saved")
        assert window.panel["saved"] == "not saved"
        assert window.control("scale")["value"] == [0.5]


def test_a_missing_mask_is_said_and_the_photo_is_shown(finished_project: Path, tmp_path: Path) -> None:
    from tiny_project import copy_of

    folder = copy_of(finished_project, tmp_path)
    masks = sorted((folder.parent / "photos" / "source" / "masks").iterdir())
    masks[2].unlink()
    with opened_editor(folder / "project.toml") as editor, Client(editor.server.port).window(size=(300, 200)) as window:
        window.step("Select")
        window.says(f"Missing masks: {masks[2].name}.")
        window.shows("Select")
        assert not window.head["problem"]
        assert window.pixels.std() > 5


def test_clicks_preview_an_outline_and_alt_marks_the_background(finished_project: Path, tmp_path: Path) -> None:
    from tiny_project import copy_of

    folder = copy_of(finished_project, tmp_path)
    shutil.rmtree(folder / "object")
    with opened_editor(folder / "project.toml") as editor, Client(editor.server.port).window(size=(320, 240)) as window:
        session = editor.require_session()
        window.step("Select")
        window.send("pointer", what="click", x=0.5, y=0.5)
        window.says("1 click in 1 of the photos. Press Cut out.")
        window.wait(lambda: bool(window.head.get("lines")), what="the outline")
        outline = np.array(window.head["lines"][0]["points"])
        assert outline[:, 0].min() < 0.5 < outline[:, 0].max()
        window.send("pointer", what="click", x=0.05, y=0.95, alt=True)
        window.says("2 clicks")
        assert session.state.prompts is not None
        (prompt,) = session.state.prompts.values()
        assert (len(prompt.inside), len(prompt.outside)) == (1, 1)
        # the place is shown although there is no object to place yet
        window.step("Place")
        window.shows("Place")
        assert window.pixels.std() > 5
        assert not window.head["problem"]


def test_sliders_weigh_the_layers_of_the_transfer_that_is_there(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # the process starts for seconds; test_view.py waits for it
    monkeypatch.setattr("splatgraft.editor.editor.LightProcess", MagicMock())
    with opened_editor(project) as editor, Client(editor.server.port).window(size=(160, 120)) as window:
        session = editor.require_session()
        pictures = session.pictures
        relit = RelitPreview(session.scenes).relit(session.placed_state())
        pictures.lit.add(session.placed_state(), "final", relit)
        window.step("Light")
        assert {name: window.control(name).get("value", 0.0) for name in asdict(LayerWeights())} == asdict(
            LayerWeights()
        )
        window.wait(
            lambda: (relit.report[0].text if relit.light is None else "Estimated: ") in window.texts(), what="the light"
        )
        before = pictures.lit.scene(session.placed_state())
        # while a slider is dragged nothing is saved
        window.send("live", id="exposure", value=1.0)
        window.wait(lambda: editor.live is not None, what="the preview")
        assert not session.history.at
        for name, value in (("exposure", 1.0), ("tint", 0.5), ("shadow", 0.25)):
            window.do(name, value)
        wanted = LayerWeights(exposure=1.0, tint=0.5, shadow=0.25)
        window.wait(lambda: read_state(session.files.file).weights == wanted, what="the weights")
        assert pictures.lit.relit(session.placed_state()) is relit
        after = pictures.lit.scene(session.placed_state())
        assert float((after.sh - before.sh)[relit.bake()[1], 0].mean()) > 0.1
        for name, value in asdict(LayerWeights()).items():
            window.do(name, value)
        wait_until(lambda: "exposure" not in session.files.file.read_text(), what="no key for what is as computed")


def test_drafts_of_a_finished_light_are_prepared_once_the_view_rests(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    process = MagicMock(is_started=False)
    monkeypatch.setattr("splatgraft.editor.editor.LightProcess", MagicMock(return_value=process))
    monkeypatch.setattr("splatgraft.editor.pictures.LitScenes.stage", lambda *_: "file")
    sent = []
    with opened_editor(project) as editor, Client(editor.server.port).window(size=(160, 120)) as window:
        process.want.side_effect = lambda state, wanted: sent.append((wanted, editor.stream.views[0].sent > 0))
        window.wait(lambda: bool(sent), what="the preparation")
        # a process that has ended starts again by an action alone
        process.is_started = True
        with editor.lock:
            count = len(sent)
            editor.poll()
            assert len(sent) == count
        assert set(sent) == {("prepared", True)}


def test_words_of_the_page_are_plain(editor: Editor, window: Client) -> None:
    bad = ("copy-paste", "gloss", "bounce", "tint", "shade", "substantial", "sets scale of", "viser")
    for step in ("Open", "Select", "Place", "Light", "Run", "Share"):
        window.step(step)
        labels = [
            str(value) for one in window.panel["controls"] for key, value in one.items() if key not in ("id", "kind")
        ]
        shown = html.unescape(" ".join(labels)).lower()
        assert not [word for word in bad if word in shown], step
    assert TOKEN not in str(window.panel)
