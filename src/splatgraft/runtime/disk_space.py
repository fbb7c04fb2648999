"""A full disk, or a file beyond the system's limit, as one line that names the folder that was being written."""

import errno
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

_NO_ROOM = {
    errno.ENOSPC: "the disk full",
    errno.EDQUOT: "the quota used up",
    errno.EFBIG: "a limit on the size of files",
}


@contextmanager
def room_on_disk(folder: Path) -> Generator[None]:
    """Turn errors of a block that found no room on the disk into one line.

    Args:
        folder: What the block writes.

    Raises:
        ValueError: There was no room.
    """
    try:
        yield
    except Exception as error:
        found = next((_NO_ROOM[number] for number in _numbers(error)), None)
        if found is None:
            raise
        raise ValueError(
            f"{folder}: expected room to write the result, found {found}; earlier results are complete, and the same "
            f"command continues when there is room"
        ) from error


def _numbers(error: BaseException | None) -> Iterator[int]:
    """The system's error numbers that mean no room, of an error and of those that it came from.

    Writers in other languages hide the number or replace the error while they close the file; its text remains.
    """
    while error is not None:
        for number in _NO_ROOM:
            if getattr(error, "errno", None) == number or f"[Errno {number}]" in str(error):
                yield number
        error = error.__cause__ or error.__context__
