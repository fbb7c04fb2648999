"""Access control of requests, and the edit lock."""

import pytest
from websockets.datastructures import Headers

from splatgraft.editor.access.access_control import (
    AccessControl,
    allowed_query,
    cookie_name,
    parse_public_address,
    plain_headers,
)
from splatgraft.editor.access.edit_lock import EditLock

HERE = {"Host": "127.0.0.1:8080"}
PAGE = HERE | {"Origin": "http://127.0.0.1:8080", "Upgrade": "websocket"}


def test_the_page_s_own_requests_are_accepted() -> None:
    for headers in (HERE, PAGE, {"Host": "localhost:8080"}, {"Host": "[::1]:8080", "Origin": "http://[::1]:8080"}):
        assert AccessControl("secret").check(headers, "/?token=secret").allowed, headers
        # programs of other users of the machine can send the same headers
        assert not AccessControl("secret").check(headers, "/").allowed, headers


@pytest.mark.parametrize(
    "headers",
    [
        HERE | {"Origin": "http://evil.example"},
        HERE | {"Origin": "null"},
        HERE | {"Origin": "http://127.0.0.1:9999"},
        PAGE | {"Origin": "http://evil.example"},
        HERE | {"Upgrade": "websocket"},
        # DNS rebinding: a foreign name that resolves to this machine
        {"Host": "evil.example:8080"},
        {"Host": "evil.example:8080", "Origin": "http://evil.example:8080"},
        {"Host": "127.0.0.1:8080, evil.example"},
        {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080, http://evil.example"},
        {},
    ],
)
def test_foreign_requests_are_refused(headers: dict[str, str]) -> None:
    assert not AccessControl("secret").check(headers, "/?token=secret").allowed


def test_other_machines_need_the_token_and_keep_it_as_a_cookie() -> None:
    access, cookie = AccessControl(hosts=(), token="secret"), "splatgraft_token_8080"
    remote = {"Host": "studio.lan:8080"}
    assert not access.check(remote, "/").allowed
    assert not access.check(remote, "/?token=other").allowed
    decision = access.check(remote, "/?token=secret")
    assert decision.allowed
    assert decision.cookie is not None
    assert "HttpOnly" in decision.cookie
    assert access.check(remote | {"Cookie": f"a=b; {cookie}=secret"}, "/assets/x.js").allowed
    assert not access.check(remote | {"Cookie": f"{cookie}=other"}, "/").allowed
    assert not access.check(remote | {"Origin": "http://evil.example", "Cookie": f"{cookie}=secret"}, "/").allowed


def test_a_server_needs_a_token() -> None:
    with pytest.raises(ValueError, match="token"):
        AccessControl("", hosts=())


def test_two_editors_on_one_host_have_a_cookie_each() -> None:
    names = [cookie_name(host) for host in ("127.0.0.1:8080", "127.0.0.1:8081", "[::1]:8080", "studio.lan")]
    assert names == [f"splatgraft_token_{key}" for key in (8080, 8081, 8080, "default")]
    both = "; ".join(f"{name}={token}" for name, token in zip(names[:2], ("first", "second"), strict=True))
    for port, token in ((8080, "first"), (8081, "second")):
        headers = {"Host": f"127.0.0.1:{port}", "Cookie": both}
        assert AccessControl(token).check(headers, "/").allowed


def test_one_window_holds_the_edit_lock_until_it_closes_or_another_takes_it() -> None:
    lock = EditLock().with_window(1).with_window(2).with_window(3)
    assert lock.holder == 1
    assert lock.without_window(2).holder == 1
    assert lock.without_window(1).holder == 2
    assert lock.held_by(3).holder == 3
    assert lock.held_by(9).holder == 1
    assert lock.held_by(3).without_window(3).holder == 1
    assert EditLock().with_window(1).without_window(1) == EditLock()


def test_the_address_behind_a_proxy_is_accepted_and_no_forwarded_header_counts() -> None:
    access = AccessControl("secret", public=parse_public_address("https://Studio.example:443/splat/"))
    for host in ("studio.example", "127.0.0.1:8080"):
        own = {"Host": host, "Origin": "https://studio.example", "Upgrade": "websocket"}
        assert access.check(own, "/?token=secret").allowed, host
        assert not access.check(own, "/?token=other").allowed, host
        for origin in ("http://studio.example", "https://studio.example:8443", "https://evil.example", "null"):
            assert not access.check(own | {"Origin": origin}, "/?token=secret").allowed, origin
    evil = {"Host": "evil.example", "X-Forwarded-Host": "studio.example", "X-Forwarded-For": "127.0.0.1"}
    assert not access.check(evil, "/?token=secret").allowed
    foreign = {"Host": "studio.example", "Origin": "https://evil.example", "X-Forwarded-Host": "evil.example"}
    assert not access.check(foreign, "/?token=secret").allowed
    # the cookie goes to the editor's part of the host alone, and only encrypted
    cookie = access.check({"Host": "studio.example"}, "/?token=secret").cookie or ""
    assert cookie.endswith("HttpOnly; SameSite=Strict; Path=/splat; Secure")


def test_editors_under_several_paths_of_a_host_share_the_cookie_s_name() -> None:
    name = cookie_name("studio.example")
    headers = {"Host": "studio.example", "Cookie": f"{name}=longer-path; {name}=root"}
    for token in ("longer-path", "root"):
        assert AccessControl(token, hosts=()).check(headers, "/").allowed
    assert not AccessControl("other", hosts=()).check(headers, "/").allowed


@pytest.mark.parametrize(
    "address",
    [
        *("studio.example", "ftp://studio.example", "https://", "https://studio.example/a?b=c", "https://a/#b"),
        *("https://user:word@studio.example", "https://studio.example/a/../b", "https://a/b;c", "https://a/\r\nb: c"),
        *("https://a:port", "javascript:alert(1)", "https://studio.example/ä"),
    ],
)
def test_other_things_than_an_address_are_refused_as_public_address(address: str) -> None:
    with pytest.raises(ValueError, match="--public-url: expected an address such as"):
        parse_public_address(address)


def test_a_page_s_query_may_hold_the_token_alone() -> None:
    assert allowed_query("/p/a/") is None
    assert allowed_query("/p/a/?token=t") is None
    assert allowed_query("/?token=t&websocket=ws://evil.example") == "?token=t"
    assert allowed_query("/?playbackPath=https://evil.example/a.viser") == "?"


def test_repeated_headers_match_nothing() -> None:
    headers = Headers([("Host", "127.0.0.1:8080"), ("Host", "evil.example"), ("Cookie", "a=b"), ("cookie", "c=d")])
    found = plain_headers(headers)
    assert found == {"Host": "127.0.0.1:8080, evil.example", "Cookie": "a=b; c=d"}
    assert not AccessControl("secret").check(found, "/?token=secret").allowed
