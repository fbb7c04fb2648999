"""clock_sun.json of a capture: the sun's direction by the photos' clock. It holds no place.

    {"candidates": [{"time": "2019-06-12T16:46:00-04:00", "clock": "GPS", "height_deg": 44.0, "direction": [x, y, z]}],
     "up": [x, y, z], "error_deg": 4.0, "height_error_deg": 2.0, "source": "the track of 54 GPS positions",
     "metres_per_unit": 151.2}

`direction` and `metres_per_unit` may be null. Without `height_error_deg`, heights have the error `error_deg`. All
vectors are in the capture's world.
"""

from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from splatgraft.core.clock_sun import ClockSun, SunCandidate
from splatgraft.formats.json_file import array, excerpt, load, number, save
from splatgraft.project.layout import CLOCK_SUN_FILE


def clock_sun_path(capture: Path) -> Path:
    """Return the path of a capture's file; `capture` is its folder, or a file in it such as transforms.json."""
    return (capture if capture.is_dir() else capture.parent) / CLOCK_SUN_FILE


def write_clock_sun(capture: Path, sun: ClockSun) -> None:
    """Write the file of a capture."""
    content = asdict(sun)
    for entry in content["candidates"]:
        entry["time"] = entry["time"].isoformat(timespec="seconds")
    save(clock_sun_path(capture), content)


def read_clock_sun(capture: Path) -> ClockSun | None:
    """Read the sun's direction by the photos' clock; None if the capture has none."""
    path = clock_sun_path(capture)
    if not path.is_file():
        return None
    content = load(path)
    if not isinstance(content, dict) or not isinstance(content.get("candidates"), list) or not content["candidates"]:
        raise ValueError(f"{path}: expected an object with a list of candidates, found {excerpt(content)}")
    metres, error_deg = content.get("metres_per_unit"), number(path, content, "error_deg")
    return ClockSun(
        candidates=tuple(_candidate(path, entry) for entry in content["candidates"]),
        up=_unit(path, content, "up"),
        error_deg=error_deg,
        height_error_deg=number(path, content, "height_error_deg") if "height_error_deg" in content else error_deg,
        source=str(content.get("source")),
        metres_per_unit=None if metres is None else number(path, content, "metres_per_unit"),
    )


def _candidate(path: Path, entry: Any) -> SunCandidate:
    try:
        time = datetime.fromisoformat(entry["time"])
    except (KeyError, TypeError, ValueError):
        time = None
    if time is None or time.utcoffset() is None:
        raise ValueError(f"{path}: expected a candidate with a time and its offset from UTC, found {excerpt(entry)}")
    direction = None if entry.get("direction") is None else _unit(path, entry, "direction")
    return SunCandidate(time, str(entry.get("clock")), number(path, entry, "height_deg"), direction)


def _unit(path: Path, entry: dict[str, Any], key: str) -> tuple[float, float, float]:
    """Return a vector of length 1."""
    vector = array(path, entry, key, ((3,),))
    length = float(np.linalg.norm(vector))
    if not 0.99 < length < 1.01:
        raise ValueError(f"{path}: expected a vector of length 1 for '{key}', found {excerpt(entry[key])}")
    x, y, z = (vector / length).tolist()
    return x, y, z
