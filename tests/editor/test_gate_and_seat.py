"""Who may come in, and who may edit."""

import pytest

from splatgraft.editor.access.access_control import COOKIE, AccessControl
from splatgraft.editor.access.edit_lock import EditLock

HERE = {"Host": "127.0.0.1:8080"}
PAGE = HERE | {"Origin": "http://127.0.0.1:8080", "Upgrade": "websocket"}


def test_the_page_itself_comes_in() -> None:
    for headers in (HERE, PAGE, {"Host": "localhost:8080"}, {"Host": "[::1]:8080", "Origin": "http://[::1]:8080"}):
        assert AccessControl().ask(headers, "/").allowed, headers


@pytest.mark.parametrize(
    "headers",
    [
        HERE | {"Origin": "http://evil.example"},
        HERE | {"Origin": "null"},
        HERE | {"Origin": "http://127.0.0.1:9999"},
        PAGE | {"Origin": "http://evil.example"},
        HERE | {"Upgrade": "websocket"},
        # a name that its owner made to point here
        {"Host": "evil.example:8080"},
        {"Host": "evil.example:8080", "Origin": "http://evil.example:8080"},
        {"Host": "127.0.0.1:8080, evil.example"},
        {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080, http://evil.example"},
        {},
    ],
)
def test_strangers_do_not(headers: dict[str, str]) -> None:
    assert not AccessControl().ask(headers, "/").allowed


def test_others_than_this_machine_need_the_token_and_keep_it_as_a_cookie() -> None:
    gate = AccessControl(hosts=(), token="secret")
    away = {"Host": "studio.lan:8080"}
    assert not gate.ask(away, "/").allowed
    assert not gate.ask(away, "/?token=other").allowed
    answer = gate.ask(away, "/?token=secret")
    assert answer.allowed
    assert answer.cookie is not None
    assert "HttpOnly" in answer.cookie
    assert gate.ask(away | {"Cookie": f"a=b; {COOKIE}=secret"}, "/assets/x.js").allowed
    assert not gate.ask(away | {"Cookie": f"{COOKIE}=other"}, "/").allowed
    assert not gate.ask(away | {"Origin": "http://evil.example", "Cookie": f"{COOKIE}=secret"}, "/").allowed


def test_an_open_door_without_a_token_cannot_be_made() -> None:
    with pytest.raises(ValueError, match="token"):
        AccessControl(hosts=())


def test_one_window_edits_until_it_leaves_or_another_takes_the_seat() -> None:
    seat = EditLock().joined(1).joined(2).joined(3)
    assert seat.holder == 1
    assert seat.left(2).holder == 1
    assert seat.left(1).holder == 2
    assert seat.taken(3).holder == 3
    assert seat.taken(9).holder == 1
    assert seat.taken(3).left(3).holder == 1
    assert EditLock().joined(1).left(1) == EditLock()
