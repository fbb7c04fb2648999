"""The page in a real browser: pictures, drags, typing, keys, touch, and the end of the server."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from editor_pages import TOKEN, opened_editor
from waiting import wait_until

from splatgraft.editor.editor import Editor
from splatgraft.editor.state import read_state
from splatgraft.project.toml_edit import with_keys


class Page:
    """A window of the browser on an editor."""

    def __init__(self, page: Any, editor: Editor) -> None:
        self.page, self.editor = page, editor
        self.errors: list[str] = []
        page.on("console", lambda entry: self.errors.append(entry.text) if entry.type == "error" else None)
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.goto(f"http://127.0.0.1:{editor.server.port}/?token={TOKEN}")
        page.wait_for_selector("#steps button")

    def until(self, condition: Any, what: str) -> None:
        wait_until(
            condition, what=f"{what}; errors {self.errors[-3:]}", pause=lambda s: self.page.wait_for_timeout(1000 * s)
        )

    def picture(self) -> tuple[int, bool]:
        """Return the number of the picture that is shown, and whether it is of full size."""
        words = (self.page.evaluate("document.body.dataset.picture") or "0 none").split()
        return int(words[0]), words[1] == "full"

    def rests(self) -> None:
        """Wait until the page shows the present state in full size."""

        def does() -> bool:
            view = self.editor.editing()
            return view is not None and view.drawn == (view.version, 1.0) and self.picture() == (view.sent, True)

        self.until(does, "a picture of full size")

    def drag(self, start: tuple[float, float], by: tuple[float, float]) -> None:
        mouse = self.page.mouse
        mouse.move(*start)
        mouse.down()
        for step in range(1, 7):
            mouse.move(start[0] + by[0] * step / 6, start[1] + by[1] * step / 6)
            self.page.wait_for_timeout(40)
        mouse.up()


@pytest.fixture
def shown(browser: Any, project: Path) -> Iterator[Page]:
    project.write_text(with_keys(project.read_text(), "relight", {"light": "off"}))
    with opened_editor(project) as editor:
        found = Page(browser.new_page(), editor)
        yield found
        found.page.close()


def test_a_user_s_story(shown: Page, project: Path) -> None:
    page, editor, session = shown.page, shown.editor, shown.editor.require_session()
    shown.rests()
    assert page.get_attribute("#steps button[aria-current=step]", "data-step") == "Place"
    # the view turns by a drag beside the object
    view = editor.editing()
    assert view is not None
    before = view.orbits["target"]
    shown.drag((60.0, 60.0), (90.0, 20.0))
    shown.until(lambda: view.orbits["target"] is not before, "the turned view")
    page.keyboard.press("Home")
    shown.until(lambda: view.photo == 0, "the first view")
    shown.rests()
    # the object moves by a drag on it, and one undo takes it back
    placed = session.objects()[0].target_from_object.translation
    hull = page.evaluate("[...Array(1)].map(() => document.querySelector('#view').getBoundingClientRect().toJSON())[0]")
    overlay = editor.panels["Place"].overlay(view, editor.orbit(view).camera(*view.canvas))  # pyright: ignore
    xs, ys = zip(*overlay["hulls"][0], strict=True)
    middle = sum(xs) / len(xs) * hull["width"], sum(ys) / len(ys) * hull["height"]
    shown.drag(middle, (50.0, 20.0))
    shown.until(lambda: bool(session.history.at), "the moved object")
    assert float((session.objects()[0].target_from_object.translation - placed).norm()) > 0.01
    page.keyboard.press("Control+z")
    shown.until(lambda: not session.history.at, "the object's first place")
    # an emptied field shows its number again, and a typed one is saved while the page is refreshed
    scale = page.locator("[data-id=scale] input")
    scale.fill("")
    scale.blur()
    shown.until(lambda: scale.input_value() == "0.8", "the number again")
    scale.fill("0.6")
    editor.refresh()
    page.wait_for_timeout(200)
    assert scale.input_value() == "0.6"
    scale.press("Enter")
    shown.until(lambda: (read_state(project).objects or [None])[0] is not None, "the saved scale")
    assert session.objects()[0].target_from_object.scale == pytest.approx(0.6)
    # keys change the step, but not while something is typed
    page.keyboard.press("2")
    shown.until(lambda: editor.step == "Select", "the step Select")
    shown.rests()
    page.click("#steps button[data-step=Share]")
    shown.until(lambda: editor.step == "Share", "the step Share")
    assert not shown.errors
    # when the server ends, the page says so
    editor.server.close()
    page.wait_for_selector("#dead:not([hidden])")


def test_a_narrow_window_works_by_touch(shown: Page) -> None:
    page, editor = shown.page, shown.editor
    page.set_viewport_size({"width": 390, "height": 780})
    shown.rests()
    view = editor.editing()
    assert view is not None
    shown.until(lambda: 0 < view.size[0] <= 780, "the canvas's size")
    before, client = view.orbits["target"], page.context.new_cdp_session(page)
    for kind, points in (
        ("touchStart", [(60, 60)]),
        ("touchMove", [(90, 70)]),
        ("touchMove", [(140, 80)]),
        ("touchEnd", []),
    ):
        touches = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        client.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})
        page.wait_for_timeout(60)
    shown.until(lambda: view.orbits["target"] is not before, "the view turned by a finger")
    distance = view.orbits["target"].distance
    for kind, far in (("touchStart", 40), ("touchMove", 60), ("touchMove", 110), ("touchEnd", 0)):
        touches = [{"x": 190 - far, "y": 90, "id": 0}, {"x": 190 + far, "y": 90, "id": 1}] if far else []
        client.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})
        page.wait_for_timeout(60)
    shown.until(lambda: view.orbits["target"].distance < 0.8 * distance, "the view zoomed by two fingers")
    # the panel fits the width
    assert page.evaluate("document.querySelector('#panel').scrollWidth <= innerWidth")
    page.tap("#steps button[data-step=Light]")
    shown.until(lambda: editor.step == "Light", "the step Light")
    assert not shown.errors
