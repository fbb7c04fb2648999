"""One line that names the file, for every failure of a parser."""

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

_LONGEST = 160  # characters of another library's message


@contextmanager
def parsing(path: Path) -> Generator[None]:
    """Turn any error while `path` is read into a ValueError of one line that names the file.

    A damaged file makes its parser raise any kind of error. Parsers raise ValueError("expected X, found Y") if that
    says more, or if reading on would be unsafe; the file's name is put before that text.
    """
    try:
        yield
    except OSError as error:
        found = error.strerror or " ".join(str(error).split())[:_LONGEST]
        raise ValueError(f"{error.filename or path}: expected a readable file, found {found}") from error
    except Exception as error:
        text = " ".join(str(error).split())
        if not isinstance(error, ValueError) or "expected " not in text or "found " not in text:
            found = f"{type(error).__name__}: {text}"[:_LONGEST]
            text = f"expected a whole {path.suffix} file, found {found}"
        # a text that does not begin with "expected" names its file, which may be another one
        raise ValueError(f"{path}: {text}" if text.startswith("expected ") else text) from error
