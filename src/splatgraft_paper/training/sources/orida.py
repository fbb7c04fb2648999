"""Photographs of the ORIDa data set (Kim et al. 2025), and a balanced choice of them (paper: 2K of 27K).

The files are listed in index.csv with the columns image, mask, background, object, scene (paths relative to it), or
without it lie in this layout:

    OBJECT/SCENE/background.*   images/NAME.*   masks/NAME.*

The choice takes photographs in rounds. Every (object, scene) has a queue in an order shuffled by the seed; a round
takes one photograph from each queue, in an order shuffled per round, first from objects and then from scenes with
fewer photographs so far. Numbers per object, and then per scene, are therefore as equal as the data allows.
"""

import csv
import random
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

from splatgraft.core.images import list_images

INDEX_FILE = "index.csv"
COLUMNS = ("image", "mask", "background", "object", "scene")
LICENCE = "ORIDa, see its own terms"


@dataclass(frozen=True)
class Photograph:
    """One photograph of an object in a scene."""

    image: Path
    mask: Path
    background: Path
    """The scene without the object."""
    object: str
    scene: str

    @property
    def name(self) -> str:
        """A unique folder name."""
        return f"{self.object}_{self.scene}_{self.image.stem}".replace("/", "-")


def read_orida(root: Path) -> list[Photograph]:
    """List all photographs, sorted by name.

    Raises:
        ValueError: the layout is another, a row is broken, or a file is missing.
    """
    found = _by_index(root / INDEX_FILE) if (root / INDEX_FILE).is_file() else _by_layout(root)
    if not found:
        raise ValueError(
            f"{root}: expected {INDEX_FILE} ({', '.join(COLUMNS)}) or OBJECT/SCENE/images, masks and background.*, "
            "found neither"
        )
    return sorted(found, key=lambda photograph: photograph.name)


def choose_balanced(photographs: list[Photograph], count: int, seed: int) -> list[Photograph]:
    """Choose `count` photographs, balanced by object and scene; all where there are fewer."""
    queues: dict[tuple[str, str], list[Photograph]] = defaultdict(list)
    for photograph in photographs:
        queues[photograph.object, photograph.scene].append(photograph)
    for key, queue in queues.items():
        random.Random(f"orida-{seed}-{key}").shuffle(queue)
    chosen: list[Photograph] = []
    objects: dict[str, int] = defaultdict(int)
    scenes: dict[str, int] = defaultdict(int)
    number = 0
    while len(chosen) < count and any(queues.values()):
        keys = sorted(key for key, queue in queues.items() if queue)
        random.Random(f"orida-{seed}-round-{number}").shuffle(keys)
        number += 1
        while keys and len(chosen) < count:
            key = min(keys, key=lambda pair: (objects[pair[0]], scenes[pair[1]]))
            keys.remove(key)
            chosen.append(queues[key].pop())
            objects[key[0]] += 1
            scenes[key[1]] += 1
    return chosen


def _by_index(path: Path) -> list[Photograph]:
    found = []
    with path.open(newline="") as stream:
        reader = csv.DictReader(stream)
        if missing := [name for name in COLUMNS if name not in (reader.fieldnames or ())]:
            raise ValueError(f"{path}: expected the columns {', '.join(COLUMNS)}, found no {missing[0]}")
        for number, row in enumerate(reader, 2):
            files = [path.parent / (row[name] or "?") for name in COLUMNS[:3]]
            if absent := next((file for file in files if not file.is_file()), None):
                raise ValueError(f"{path}, line {number}: expected existing files, found no {absent}")
            image, mask, background = files
            found.append(Photograph(image, mask, background, row["object"], row["scene"]))
    return found


def _by_layout(root: Path) -> list[Photograph]:
    found = []
    for images in sorted(root.glob("*/*/images")):
        scene = images.parent
        background = next((path for path in list_images(scene) if path.stem == "background"), None)
        if background is None:
            raise ValueError(f"{scene}: expected background.*, the scene without the object, found none")
        masks = {path.stem: path for path in list_images(scene / "masks")} if (scene / "masks").is_dir() else {}
        for image in list_images(images):
            if image.stem not in masks:
                raise ValueError(f"{scene / 'masks'}: expected a mask {image.stem}.*, found none")
            found.append(Photograph(image, masks[image.stem], background, scene.parent.name, scene.name))
    return found
