"""The page at the sizes of a desktop, a small laptop and a phone: nothing is cut off, and the scene stays in view."""

import pytest
from editor_driver import Window
from test_hostile_values import made, project

__all__ = ["made", "project"]
PHASES = ("Open", "Select", "Place", "Light", "Run")


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (1024, 700), (372, 800)])
def test_controls_fit_and_the_scene_is_seen(window: Window, width: int, height: int) -> None:
    page = window.page
    page.set_viewport_size({"width": width, "height": height})
    for phase in PHASES:
        window.show_phase(phase)
        names = [f"\u25cf {name}" if name == phase else name for name in PHASES]
        buttons = [page.get_by_role("button", name=name, exact=True).first for name in names]
        window.until(lambda buttons=buttons: all(one.is_visible() for one in buttons), what="the steps")
        boxes = [one.bounding_box() for one in buttons]
        assert len({round(box["y"]) for box in boxes}) == 1, f"the steps of {phase} wrap: {boxes}"
        assert boxes[0]["x"] >= 0
        assert boxes[-1]["x"] + boxes[-1]["width"] <= width
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        # what a field shows is not cut
        cut = page.evaluate(
            "Array.from(document.querySelectorAll('input[inputmode]')).filter("
            "e => e.offsetParent && e.scrollWidth > e.clientWidth + 1).map(e => e.value)"
        )
        assert cut == [], f"{phase}: {cut}"
        # the middle of the scene, where the gizmo is, is not covered
        assert boxes[0]["x"] > width / 2 or boxes[0]["y"] > height / 2
    assert window.unknown_errors() == []
