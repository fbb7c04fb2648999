"""States that were left behind, as files by their content, and the history as a list of their names.

So undo has no bound, costs no memory, and goes on after the editor ended. Knows nothing about what a state is for.
"""

import hashlib
import json
import os
from collections import OrderedDict
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatgraft.core.similarity import Similarity
from splatgraft.editor.session.edit_state import EditState
from splatgraft.editor.session.history import History
from splatgraft.formats.placement import ObjectPlacement
from splatgraft.relighting import LayerWeights, light_from_json, light_to_json
from splatgraft.runtime.atomic_file import atomic_write

HISTORY_FILE, STATES_FOLDER = "history.json", "states"
_IN_MEMORY = 20
"""States that need not be read again; also, what was drawn for them is known by them being the same objects."""


class StateStore:
    """The states of one project, under `folder`; paths of objects are kept relative to `home`."""

    def __init__(self, folder: Path, *, home: Path) -> None:
        """Nothing is read yet."""
        self._folder, self._home = folder, home
        self._near: OrderedDict[str, EditState] = OrderedDict()
        self._arrays: dict[int, tuple[Tensor, str]] = {}

    def keep(self, state: EditState) -> str:
        """Write the state where it is not there yet; its name."""
        (self._folder / STATES_FOLDER).mkdir(parents=True, exist_ok=True)
        text = json.dumps(self._plain(state), sort_keys=True)
        name = _name(text.encode())
        if not self._path(name, ".json").is_file():
            with atomic_write(self._path(name, ".json")) as stream:
                stream.write(text.encode())
        self._remember(name, state)
        return name

    def read(self, name: str) -> EditState:
        """The state of that name.

        Raises: ValueError where its file is missing or broken.
        """
        if name not in self._near:
            path = self._path(name, ".json")
            try:
                self._remember(name, self._state(json.loads(path.read_text(encoding="utf-8"))))
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise ValueError(f"{path}: expected an earlier state, found {type(error).__name__}: {error}") from error
        self._near.move_to_end(name)
        return self._near[name]

    def history(self) -> History[str] | None:
        """The names of all states as they were left; None where there are none. What no step leads to is removed.

        Raises: ValueError where the list is broken.
        """
        path = self._folder / HISTORY_FILE
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            history = History(str(found["present"]), _names(found["past"]), _names(found["future"]))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: expected a history, found {type(error).__name__}: {error}") from error
        self._clear({history.present, *history.past, *history.future})
        return history

    def keep_history(self, history: History[str]) -> None:
        """Replace the list of names."""
        record = {"past": history.past, "present": history.present, "future": history.future}
        with atomic_write(self._folder / HISTORY_FILE) as stream:
            stream.write(json.dumps(record).encode())

    def _path(self, name: str, suffix: str) -> Path:
        return self._folder / STATES_FOLDER / f"{name}{suffix}"

    def _remember(self, name: str, state: EditState) -> None:
        self._near.setdefault(name, state)
        while len(self._near) > _IN_MEMORY:
            self._near.popitem(last=False)
        used = {id(array) for kept in self._near.values() for array in (kept.erased, kept.corrections)}
        self._arrays = {key: value for key, value in self._arrays.items() if key in used}

    def _clear(self, used: set[str]) -> None:
        """Remove states that none of `used` is, and arrays that none of them names."""
        texts = [path.read_text() for name in used if (path := self._path(name, ".json")).is_file()]
        arrays = {found[key] for text in texts for found in [json.loads(text)] for key in ("erased", "corrections")}
        for path in (self._folder / STATES_FOLDER).glob("*"):
            if path.stem not in used and path.stem not in arrays:
                path.unlink()

    # a state as JSON; arrays have files of their own, since most steps leave them as they are

    def _plain(self, state: EditState) -> dict[str, Any]:
        objects = None if state.objects is None else [self._plain_object(item) for item in state.objects]
        return {
            "objects": objects,
            "erased": self._kept_array(state.erased),
            "corrections": self._kept_array(state.corrections),
            "mask_source": state.mask_source,
            "box": state.box,
            "keep": state.keep,
            "light": None if state.light is None else light_to_json(state.light),
            "weights": asdict(state.weights),
            "harmonizer": state.harmonizer,
        }

    def _state(self, plain: dict[str, Any]) -> EditState:
        objects, box, light = plain["objects"], plain["box"], plain["light"]
        a, b, c, d, e, f = (float(x) for x in box) if box is not None else (0.0,) * 6
        return EditState(
            objects=None if objects is None else tuple(self._object(item) for item in objects),
            erased=self._array(plain["erased"]),
            corrections=self._array(plain["corrections"]),
            mask_source=plain["mask_source"],
            box=None if box is None else (a, b, c, d, e, f),
            keep=plain["keep"],
            light=None if light is None else light_from_json(light),
            weights=LayerWeights(**plain["weights"]),
            harmonizer=plain["harmonizer"],
        )

    def _plain_object(self, item: ObjectPlacement) -> dict[str, Any]:
        move, path = item.target_from_object, item.object_path
        numbers = {"scale": move.scale, "rotation": move.rotation.tolist(), "translation": move.translation.tolist()}
        return numbers | {"object": None if path is None else os.path.relpath(path, self._home)}

    def _object(self, plain: dict[str, Any]) -> ObjectPlacement:
        move = Similarity(
            scale=float(plain["scale"]),
            rotation=torch.tensor(plain["rotation"]),
            translation=torch.tensor(plain["translation"]),
        )
        return ObjectPlacement(move, None if plain["object"] is None else self._home / plain["object"])

    def _kept_array(self, array: Tensor | None) -> str | None:
        if array is None:
            return None
        known = self._arrays.get(id(array))
        if known is not None and known[0] is array:
            return known[1]
        numbers = array.cpu().numpy()
        name = _name(str(numbers.dtype).encode() + numbers.tobytes())
        if not self._path(name, ".npz").is_file():
            content = BytesIO()
            np.savez_compressed(content, numbers=numbers)
            with atomic_write(self._path(name, ".npz")) as stream:
                stream.write(content.getvalue())
        self._arrays[id(array)] = (array, name)
        return name

    def _array(self, name: str | None) -> Tensor | None:
        if name is None:
            return None
        # the very tensor that a near state has, so that what was made of it is known to be right still
        for array, known in self._arrays.values():
            if known == name:
                return array
        with np.load(self._path(name, ".npz"), allow_pickle=False) as content:
            array = torch.from_numpy(content["numbers"])
        self._arrays[id(array)] = (array, name)
        return array


def _name(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:24]


def _names(found: Any) -> tuple[str, ...]:
    return tuple(str(name) for name in found)
