"""Random use of the editor in two windows, by a seed of the day: no error, and the page shows what is on the disk."""

import datetime
import random
from pathlib import Path

import numpy as np
import pytest
import torch
from editor_pages import Client, opened_editor

from splatgraft.editor.state import read_state
from splatgraft.project.toml_edit import with_keys

ACTIONS = 300
"""Number of actions; the time that they take is the machine's."""


def random_action(chance: random.Random, window: Client) -> None:
    """Send what a hand might do."""
    x, y = chance.random(), chance.random()
    kind = chance.choice(["control", "control", "step", "key", "drag", "click", "turn", "zoom", "split", "size"])
    usable = [
        one for one in window.panel["controls"] if one["kind"] in ("check", "choice", "slider", "numbers", "buttons")
    ]
    if kind == "control" and usable:
        one = chance.choice(usable)
        if one["id"] in ("look_source", "look_target", "up_source", "up_target"):
            return  # these start a job
        values = {
            "check": lambda: chance.random() < 0.5,
            "choice": lambda: chance.choice(one["options"]),
            "buttons": lambda: chance.choice(one["options"]),
            "slider": lambda: chance.uniform(one["min"], one["max"]) if one["id"] != "photo" else one["min"],
            "numbers": lambda: [value + chance.uniform(-0.2, 0.2) for value in one["value"]],
        }
        window.send("do", id=one["id"], value=values[one["kind"]]())
    elif kind == "step":
        window.send("step", to=chance.choice(["Open", "Select", "Place", "Light", "Run", "Share"]))
    elif kind == "key":
        keys = [
            "ctrl+z",
            "ctrl+z",
            "ctrl+shift+z",
            "f",
            "home",
            "g",
            "b",
            "arrowleft",
            "arrowup",
            "escape",
            "ctrl+d",
            "delete",
        ]
        window.send("key", key=chance.choice(keys))
    elif kind == "drag":
        mode = chance.choice(["move", "turn", "size", "lift"])
        on = chance.choice(["object:0", "object:0", "object:1", "lower", "upper", "light:0"])
        for what in ("down", "move", "move", chance.choice(["up", "up", "cancel"])):
            x, y = x + chance.uniform(-0.05, 0.05), y + chance.uniform(-0.05, 0.05)
            window.send("pointer", what=what, on=on, x=x, y=y, mode=mode, alt=chance.random() < 0.2)
    elif kind == "click":
        window.send("pointer", what="click", x=x, y=y, alt=chance.random() < 0.3)
    elif kind in ("turn", "split"):
        window.send(kind, x=x - 0.5 if kind == "turn" else x, y=y - 0.5)
    elif kind == "zoom":
        window.send("zoom", by=x - 0.5)
    else:
        window.send("size", w=chance.choice([120, 200]), h=chance.choice([90, 160]))


@pytest.mark.long
def test_random_use_in_two_windows(project: Path, capfd: pytest.CaptureFixture[str]) -> None:
    seed = datetime.date.today().toordinal()
    print(f"seed {seed}")
    chance = random.Random(seed)
    project.write_text(with_keys(project.read_text(), "relight", {"light": "off"}))
    with opened_editor(project) as editor:
        first, second = Client(editor.server.port), Client(editor.server.port)
        with first.window(size=(160, 120)), second.window(size=(120, 90)):
            session = editor.require_session()
            for number in range(ACTIONS):
                window = second if chance.random() < 0.2 else first
                random_action(chance, window)
                first.listen(0.05)
                second.listen(0.02)
                if number % 20 == 0:
                    first.send("pointer", what="cancel", on="", x=0, y=0)
            first.step("Place")
            first.wait(lambda: editor._actions.empty() and editor.live is None, what="the last action")
            state, written = session.placed_state(), read_state(project)
            assert first.panel["saved"] == "saved"
            if state.objects and written.objects is not None:
                for a, b in zip(state.objects, written.objects, strict=True):
                    assert a.target_from_object.scale == pytest.approx(b.target_from_object.scale, rel=1e-6)
                    assert torch.allclose(a.target_from_object.translation, b.target_from_object.translation, atol=1e-5)
            assert (state.box, state.keep, state.mask_source) == (written.box, written.keep, written.mask_source)
            assert state.weights == written.weights
            first.finished()
            assert np.isfinite(first.pixels).all()
            while session.step(-1):
                pass
    assert "Traceback" not in capfd.readouterr().err
