"""The undo history on disk: each state in a file named by the hash of its content, and a list of these names.

Undo is therefore unbounded, needs little memory, and survives the end of the editor.
"""

import contextlib
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
from splatgraft.editor.session.state_checks import check_state
from splatgraft.formats.placement import ObjectPlacement
from splatgraft.formats.prompts import prompts_from_json, prompts_to_json
from splatgraft.relighting import LayerWeights, light_from_json, light_to_json
from splatgraft.runtime.files import atomic_write

HISTORY_FILE, STATES_FOLDER = "history.json", "states"
_UNREADABLE = (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError, RecursionError, EOFError)
"""What a damaged file may raise."""
_IN_MEMORY = 20
"""Number of states held in memory; memos recognise such a state by the identity of its parts."""


class StateStore:
    """The stored states of one project."""

    def __init__(self, folder: Path, *, project_folder: Path) -> None:
        """Open the store without reading.

        Args:
            folder: Folder of the stored states.
            project_folder: Folder to which the paths of objects are stored relative.
        """
        self._folder, self._project_folder = folder, project_folder
        self._recent: OrderedDict[str, EditState] = OrderedDict()
        self._arrays: dict[int, tuple[Tensor, str]] = {}

    def save(self, state: EditState) -> str:
        """Write the state unless it is stored already; returns its name."""
        (self._folder / STATES_FOLDER).mkdir(parents=True, exist_ok=True)
        text = json.dumps(self._to_json(state), sort_keys=True)
        name = _name(text.encode())
        if not self._path(name, ".json").is_file():
            with atomic_write(self._path(name, ".json")) as stream:
                stream.write(text.encode())
        self._remember(name, state)
        return name

    def read(self, name: str) -> EditState:
        """The state of that name.

        Raises:
            ValueError: If its file is missing or invalid.
        """
        if name not in self._recent:
            path = self._path(name, ".json")
            try:
                state = self._from_json(json.loads(path.read_text(encoding="utf-8")))
                check_state(state)
                self._remember(name, state)
            except _UNREADABLE as error:
                raise ValueError(f"{path}: expected an earlier state, found {type(error).__name__}: {error}") from error
        self._recent.move_to_end(name)
        return self._recent[name]

    def read_history(self) -> History[str] | None:
        """Read the history and delete states that are not in it; None where none is stored.

        Raises:
            ValueError: If the list is invalid.
        """
        path = self._folder / HISTORY_FILE
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            history = History(str(found["present"]), _names(found["past"]), _names(found["future"]))
        except FileNotFoundError:
            return None
        except _UNREADABLE as error:
            raise ValueError(f"{path}: expected a history, found {type(error).__name__}: {error}") from error
        self._remove_unused({history.present, *history.past, *history.future})
        return history

    def save_history(self, history: History[str]) -> None:
        """Write the list of names."""
        record = {"past": history.past, "present": history.present, "future": history.future}
        with atomic_write(self._folder / HISTORY_FILE) as stream:
            stream.write(json.dumps(record).encode())

    def paths(self) -> tuple[Path, ...]:
        """The file of the history and the folder of the states."""
        return self._folder / HISTORY_FILE, self._folder / STATES_FOLDER

    def _path(self, name: str, suffix: str) -> Path:
        return self._folder / STATES_FOLDER / f"{name}{suffix}"

    def _remember(self, name: str, state: EditState) -> None:
        self._recent.setdefault(name, state)
        while len(self._recent) > _IN_MEMORY:
            self._recent.popitem(last=False)
        used = {id(array) for state in self._recent.values() for array in (state.erased, state.corrections)}
        self._arrays = {key: value for key, value in self._arrays.items() if key in used}

    def _remove_unused(self, used: set[str]) -> None:
        """Delete all states but those in `used`, and all arrays that these do not refer to."""
        arrays: set[str] = set()
        for path in (self._path(name, ".json") for name in used):
            # a state that cannot be read is passed over by undo
            with contextlib.suppress(*_UNREADABLE):
                found = json.loads(path.read_text(encoding="utf-8"))
                arrays |= {str(found["erased"]), str(found["corrections"])}
        for path in (self._folder / STATES_FOLDER).glob("*"):
            if path.stem not in used and path.stem not in arrays:
                path.unlink()

    # a state as JSON; arrays are stored in separate files, because most steps do not change them

    def _to_json(self, state: EditState) -> dict[str, Any]:
        objects = None if state.objects is None else [self._object_to_json(item) for item in state.objects]
        return {
            "objects": objects,
            "erased": self._save_array(state.erased),
            "corrections": self._save_array(state.corrections),
            "mask_source": state.mask_source,
            "box": state.box,
            "keep": state.keep,
            "prompts": None if state.prompts is None else prompts_to_json(state.prompts),
            "light": None if state.light is None else light_to_json(state.light),
            "weights": asdict(state.weights),
            "harmonizer": state.harmonizer,
        }

    def _from_json(self, fields: dict[str, Any]) -> EditState:
        objects, box, light = fields["objects"], fields["box"], fields["light"]
        a, b, c, d, e, f = (float(x) for x in box) if box is not None else (0.0,) * 6
        return EditState(
            objects=None if objects is None else tuple(self._object_from_json(item) for item in objects),
            erased=self._read_array(fields["erased"]),
            corrections=self._read_array(fields["corrections"]),
            mask_source=fields["mask_source"],
            box=None if box is None else (a, b, c, d, e, f),
            keep=fields["keep"],
            prompts=None if (found := fields.get("prompts")) is None else prompts_from_json(found, "prompts"),
            light=None if light is None else light_from_json(light),
            weights=LayerWeights(**fields["weights"]),
            harmonizer=fields["harmonizer"],
        )

    def _object_to_json(self, item: ObjectPlacement) -> dict[str, Any]:
        placement, path = item.target_from_object, item.object_path
        numbers = {
            "scale": placement.scale,
            "rotation": placement.rotation.tolist(),
            "translation": placement.translation.tolist(),
        }
        return numbers | {"object": None if path is None else os.path.relpath(path, self._project_folder)}

    def _object_from_json(self, fields: dict[str, Any]) -> ObjectPlacement:
        placement = Similarity(
            scale=float(fields["scale"]),
            rotation=torch.tensor(fields["rotation"]),
            translation=torch.tensor(fields["translation"]),
        )
        return ObjectPlacement(placement, None if fields["object"] is None else self._project_folder / fields["object"])

    def _save_array(self, array: Tensor | None) -> str | None:
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

    def _read_array(self, name: str | None) -> Tensor | None:
        if name is None:
            return None
        # the same tensor as in a recent state, so that memos of it stay valid
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
