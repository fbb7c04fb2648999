"""Reads the cameras that Metashape exports (File > Export > Export Cameras, Agisoft XML): poses and lenses, no points.

The lens is that of the Metashape manual, appendix "Camera models": its P1 and P2 are OpenCV's p2 and p1, its principal
point is measured from the middle of the image, and B1 is added to the horizontal focal length.
"""

from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np

from splatgraft.formats.captures.view_record import MAX_SIDE, ViewRecord, rigid

_UNSUPPORTED = ("k4", "p3", "p4", "b2")


def read_views(path: Path) -> list[ViewRecord]:
    """The cameras with a pose, in the file's order, without images; names are Metashape's labels.

    Raises: ValueError where the file is no such export, has no pose, or a lens is not supported.
    """
    try:
        root = Xml.parse(path).getroot()
    except (Xml.ParseError, OSError) as error:
        raise ValueError(f"{path}: expected cameras in Metashape's XML, found {error}") from error
    lenses = {sensor.get("id"): sensor for sensor in root.iter("sensor")}
    views = list(_views(path, root, lenses))
    if not views:
        raise ValueError(f"{path}: expected cameras with a transform in Metashape's XML, found none")
    return views


def _views(path: Path, root: Xml.Element, lenses: dict[str | None, Xml.Element]) -> Iterator[ViewRecord]:
    for camera in root.iter("camera"):
        transform, label = camera.find("transform"), camera.get("label", "")
        if transform is None:
            continue
        numbers = _numbers(path, label, transform.text)
        if len(numbers) != 16:
            raise ValueError(f"{path}: expected 16 numbers as transform of {label}, found {len(numbers)}")
        sensor = lenses.get(camera.get("sensor_id"))
        if sensor is None:
            raise ValueError(f"{path}: expected the sensor of {label}, found none")
        width, height = _size(path, label, sensor)
        lens = _calibration(path, label, sensor)
        yield ViewRecord(
            name=label,
            image_path=None,
            world_from_camera=rigid(np.array(numbers).reshape(4, 4), f"{path}: {label}"),
            focal=(lens["f"] + lens.get("b1", 0.0), lens["f"]),
            center=(width / 2 + lens.get("cx", 0.0), height / 2 + lens.get("cy", 0.0)),
            size=(width, height),
            distortion=tuple(lens.get(name, 0.0) for name in ("k1", "k2", "p2", "p1", "k3")),
        )


def _size(path: Path, label: str, sensor: Xml.Element) -> tuple[int, int]:
    resolution = sensor.find("resolution")
    words = ("", "") if resolution is None else (resolution.get("width", ""), resolution.get("height", ""))
    if not all(word.isdigit() and 0 < int(word) <= MAX_SIDE for word in words):
        raise ValueError(
            f"{path}: expected a resolution of up to {MAX_SIDE} px for the sensor of {label}, found {words}"
        )
    return int(words[0]), int(words[1])


def _calibration(path: Path, label: str, sensor: Xml.Element) -> dict[str, float]:
    """The adjusted calibration, by parameter."""
    found = sensor.findall("calibration")
    adjusted = next((c for c in found if c.get("class") == "adjusted"), found[-1] if found else None)
    if adjusted is None or adjusted.get("type", "frame") != "frame":
        kind = "none" if adjusted is None else adjusted.get("type")
        raise ValueError(f"{path}: expected a calibration of type frame for the sensor of {label}, found {kind}")
    lens = {p.tag: _numbers(path, label, p.text)[0] for p in adjusted if p.tag != "resolution" and p.text}
    other = [f"{name} = {lens[name]:g}" for name in _UNSUPPORTED if lens.get(name)]
    if other or lens.get("f", 0.0) <= 0:
        raise ValueError(
            f"{path}: expected f, cx, cy, b1, k1 to k3, p1 and p2 for the sensor of {label}, "
            f"found {', '.join(other) or 'no f'}; undistort the photos in Metashape, or export to COLMAP"
        )
    return lens


def _numbers(path: Path, label: str, text: str | None) -> list[float]:
    try:
        return [float(word) for word in (text or "").split()] or [float("")]
    except ValueError:
        raise ValueError(f"{path}: expected numbers for {label}, found {(text or '')[:40]!r}") from None
