"""HTTP messages of the front server: requests as the websockets library reads them, and answers of its own."""

import http
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field

from websockets.http11 import Request

MAX_HEAD_BYTES = 32 << 10
"""Largest head of a request or an answer."""
_CONTENT_POLICY = (
    "default-src 'none'; style-src 'self'; script-src 'self'; img-src 'self' data:; connect-src 'self';"
    " base-uri 'self'; form-action 'none'; frame-ancestors 'none'"
)


def parse_request(head: bytes) -> Request:
    """The request of a head.

    Args:
        head: Request line and headers, to the empty line.

    Raises:
        ValueError: If it is not a GET request without a body, as HTTP/1.1 writes it.
    """
    lines = iter(head.split(b"\n"))

    def read_line(limit: int) -> Generator[None, None, bytes]:
        yield from ()
        line = next(lines) + b"\n"
        if len(line) > limit:
            raise ValueError
        return line

    parser = Request.parse(read_line)
    try:
        next(parser)
    except StopIteration as done:
        return _checked(done.value)
    except Exception as error:  # the library has several kinds
        raise ValueError(str(error)) from error
    raise AssertionError("the parser waits for more than a whole head")


def _checked(request: Request) -> Request:
    """Raises: ValueError where the path is no path of plain letters, which could not be written into a header."""
    if not request.path.startswith("/") or not request.path.isascii() or not request.path.isprintable():
        raise ValueError
    return request


@dataclass(frozen=True)
class Answer:
    """An answer of the front server itself."""

    body: bytes = b""
    """The content."""
    kind: str = "text/plain; charset=utf-8"
    """Its media type."""
    status: http.HTTPStatus = http.HTTPStatus.OK
    """The status."""
    headers: Mapping[str, str] = field(default_factory=dict)
    """More headers."""

    def serialized(self, cookie: str | None) -> bytes:
        """The bytes to send.

        Args:
            cookie: A Set-Cookie header; None: no such header.
        """
        headers = {
            "Content-Type": self.kind,
            "Content-Length": str(len(self.body)),
            "Cache-Control": "no-store",
            "Connection": "close",
            "Content-Security-Policy": _CONTENT_POLICY,
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            **self.headers,
        }
        if cookie is not None:
            headers["Set-Cookie"] = cookie
        head = [f"HTTP/1.1 {int(self.status)} {self.status.phrase}", *(f"{k}: {v}" for k, v in headers.items())]
        return "\r\n".join([*head, "", ""]).encode("latin-1") + self.body


def refusal(status: http.HTTPStatus, sentence: str) -> Answer:
    """A refusal with its reason."""
    return Answer(f"splatgraft: {sentence}\n".encode(), status=status)


def moved(location: str) -> Answer:
    """A redirection to an address relative to that of the request."""
    return Answer(status=http.HTTPStatus.FOUND, headers={"Location": location})


def with_cookie(head: bytes, cookie: str | None) -> bytes:
    """The head of an answer with one more header."""
    if cookie is None:
        return head
    first, _, rest = head.partition(b"\r\n")
    return b"\r\n".join([first, f"Set-Cookie: {cookie}".encode("latin-1"), rest])
