"""How tall a placed object is in centimetres, and the metric scales of both captures that say so (`scale.json`)."""

from dataclasses import dataclass
from pathlib import Path

from splatgraft.editor.session.session import Session
from splatgraft.editor.session.state_checks import check_height_cm
from splatgraft.formats.metric_scale import MetricScale, read_scale, write_scale


@dataclass(frozen=True)
class ObjectSize:
    """The size of one placed object, and what is known of the captures' units."""

    height: float
    """From its base to its top, units of its own capture."""
    scale: float
    """Size in the target over size in its own capture."""
    own: MetricScale | None
    """Of its own capture; None where it is not known, or the object was added from a file."""
    place: MetricScale | None
    """Of the target's capture; None where it is not known."""

    @property
    def here_cm(self) -> float | None:
        """Height in the target; None where its scale is not known."""
        return None if self.place is None else 100 * self.place.metres_per_unit * self.scale * self.height

    @property
    def true_cm(self) -> float | None:
        """Height in its own capture; None where that one's scale is not known."""
        return None if self.own is None else 100 * self.own.metres_per_unit * self.height

    def scale_at(self, here_cm: float) -> float:
        """The `scale` at which the object is that tall in the target.

        Raises:
            ValueError: The height is out of range, or the target's scale is not known.
        """
        check_height_cm(here_cm)
        if self.place is None:
            raise ValueError("target: expected a capture whose scale is known, found none; see `splatgraft scale`")
        return 0.01 * here_cm / (self.place.metres_per_unit * self.height)

    def own_from(self, true_cm: float) -> MetricScale:
        """The scale of its own capture, where the object is that tall.

        Raises:
            ValueError: The height is out of range.
        """
        check_height_cm(true_cm)
        return MetricScale(0.01 * true_cm / self.height, f"the object's height of {true_cm:g} cm")

    def place_from(self, here_cm: float) -> MetricScale:
        """The scale of the target's capture, where the object is that tall at its present scale.

        Raises:
            ValueError: The height is out of range.
        """
        check_height_cm(here_cm)
        found = 0.01 * here_cm / (self.scale * self.height)
        return MetricScale(found, f"a placed object's height of {here_cm:g} cm")


def size_of(session: Session, index: int) -> ObjectSize:
    """The size of one placed object.

    Raises:
        ValueError: If its file or a scale.json cannot be read.
    """
    item = session.objects()[index]
    is_own = session.scenes.object_path(item) == session.files.object
    return ObjectSize(
        height=session.placeable_object(index).base.height,
        scale=item.target_from_object.scale,
        own=read_scale(session.files.source_cameras) if is_own else None,
        place=read_scale(session.files.target_cameras),
    )


def true_scale(session: Session) -> float | None:
    """The scale at which the source's object is as large as it was; None where a capture's scale is not known.

    Raises:
        ValueError: If a scale.json cannot be read.
    """
    own, place = read_scale(session.files.source_cameras), read_scale(session.files.target_cameras)
    return None if own is None or place is None else own.metres_per_unit / place.metres_per_unit


def set_own_scale(session: Session, index: int, true_cm: float) -> Path:
    """Store the scale of an object's own capture from the object's true height; gives the file.

    Raises:
        ValueError: As `ObjectSize.own_from`, or the object was added from a file.
    """
    path = session.scenes.object_path(session.objects()[index])
    if path != session.files.object:
        raise ValueError(f"{path}: expected the object of the project's source, found one that was added from a file")
    return write_scale(session.files.source_cameras, size_of(session, index).own_from(true_cm))


def set_place_scale(session: Session, index: int, here_cm: float) -> Path:
    """Store the scale of the target's capture from a placed object's height in it; gives the file.

    Raises:
        ValueError: As `ObjectSize.place_from`.
    """
    return write_scale(session.files.target_cameras, size_of(session, index).place_from(here_cm))
