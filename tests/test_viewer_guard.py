"""The viewer's server, really started, answers its own page and nobody else's."""

import contextlib
import http.client
import socket
from collections.abc import Iterator

import pytest

from mereo.visualization.viewer import display, guard

pytest.importorskip("viser", reason="viser (extra `view`) is not installed")

import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

FOREIGN = ("http://evil.example", "null", "http://127.0.0.1:1", "http://127.0.0.1.evil.example", "https://127.0.0.1")


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    started = display.start_server(0, "mereo")
    yield started.get_port()
    display.stop_server(started)


def first_message(port: int, host: str, origin: str | None) -> bytes:
    """What the websocket says first, asked by a page of ``origin`` for the name ``host``."""
    with (
        socket.create_connection(("127.0.0.1", port), timeout=20) as line,
        connect(f"ws://{host}", sock=line, origin=origin, subprotocols=[f"viser-v{viser.__version__}"]) as page,
    ):
        return bytes(page.recv(timeout=20))


def status(port: int, **headers: str) -> int:
    """Of the page itself, asked with these headers beside, or in place of, the usual ones."""
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=20)) as line:
        line.request("GET", "/", headers=headers)
        return line.getresponse().status


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "LocalHost", "[::1]"])
def test_its_own_page_gets_the_scene(port: int, name: str) -> None:
    host = f"{name}:{port}"
    assert first_message(port, host, f"http://{name.lower()}:{port}")
    assert first_message(port, host, None)
    assert status(port, Host=host) == 200


def test_the_end_of_a_tunnel_is_its_own_page(port: int) -> None:
    assert first_message(port, "localhost:9000", "http://localhost:9000")


@pytest.mark.parametrize("origin", FOREIGN)
def test_a_page_of_another_address_gets_nothing(port: int, origin: str) -> None:
    with pytest.raises(InvalidStatus, match="403"):
        first_message(port, f"127.0.0.1:{port}", origin)
    assert status(port, Origin=origin) == 403


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example", "user@127.0.0.1", "0.0.0.0", "127.0.0.2"])
def test_another_name_of_this_machine_gets_nothing(port: int, host: str) -> None:
    """A name that an attacker makes to mean 127.0.0.1: page and websocket then have the same address."""
    assert status(port, Host=f"{host}:{port}") == 403
    if "@" not in host:
        with pytest.raises(InvalidStatus, match="403"):
            first_message(port, f"{host}:{port}", f"http://{host}:{port}")


def test_a_refusal_says_which_address_to_open() -> None:
    assert guard.refusal(["evil.example"], []).startswith("the host is evil.example; it must be 127.0.0.1 or localhost")
    assert "host is not given" in guard.refusal([], []) and guard.refusal(["localhost", "localhost"], [])
    assert "only pages of http://localhost:80 are answered" in guard.refusal(["localhost:80"], ["http://a.example"])
    assert guard.refusal(["localhost:80"], ["http://localhost:80"]) == ""


def test_a_viser_that_cannot_be_guarded_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    @contextlib.contextmanager
    def unused(*_: object) -> Iterator[list[str]]:
        yield []

    monkeypatch.setattr(display, "guarded_servers", unused)
    with pytest.raises(ImportError, match="starts its server in a way that mereo cannot guard"):
        display.start_server(0, "mereo")


# --- bound to another address -----------------------------------------------------------------------------------------

OTHER = "127.0.0.2"
"""An address that is not this machine's usual own, as one of a network would be, and that nobody else reaches."""


@pytest.fixture(scope="module")
def open_port() -> Iterator[tuple[int, guard.Entry]]:
    entry = guard.Entry.of(OTHER)
    try:
        started = display.start_server(0, "mereo", entry)
    except OSError as error:
        pytest.skip(f"this system has no {OTHER}: {error}")
    yield started.get_port(), entry
    display.stop_server(started)


def page_of(port: int, path: str, **headers: str) -> tuple[int, str]:
    """Status of a page of the other address, and the cookie that comes with it."""
    with contextlib.closing(http.client.HTTPConnection(OTHER, port, timeout=20)) as line:
        line.request("GET", path, headers=headers)
        answer = line.getresponse()
        return answer.status, answer.getheader("Set-Cookie") or ""


def socket_of(port: int, **headers: str) -> bytes:
    with connect(
        f"ws://{OTHER}:{port}", origin=f"http://{OTHER}:{port}", additional_headers=headers,
        subprotocols=[f"viser-v{viser.__version__}"],
    ) as page:  # fmt: skip
        return bytes(page.recv(timeout=20))


def test_another_address_needs_the_token_that_is_printed(open_port: tuple[int, guard.Entry]) -> None:
    port, entry = open_port
    assert len(entry.token) == 32 and entry.address(port) == f"http://{OTHER}:{port}/?token={entry.token}"
    assert [page_of(port, path)[0] for path in ("/", "/?token=", "/?token=wrong", "/?token=%ff")] == [403] * 4
    status, cookie = page_of(port, f"/?token={entry.token}")
    assert status == 200 and cookie.endswith("; Path=/; HttpOnly; SameSite=Strict")
    kept = cookie.partition(";")[0]
    assert page_of(port, "/", Cookie=kept) == (200, "")
    assert page_of(port, "/", Cookie=kept, Origin="http://evil.example")[0] == 403
    assert page_of(port, "/", Cookie=f"mereo_{port}=wrong")[0] == 403
    assert socket_of(port, Cookie=kept)
    for headers in ({}, {"Cookie": f"mereo_{port}=wrong"}, {"Cookie": f"mereo_1={entry.token}"}):
        with pytest.raises(InvalidStatus, match="403"):
            socket_of(port, **headers)


def test_tokens_are_random_and_this_machine_needs_none() -> None:
    assert guard.Entry.of("0.0.0.0").token != guard.Entry.of("0.0.0.0").token
    assert all(not guard.Entry.of(host).token for host in ("127.0.0.1", "localhost", "::1"))
    assert guard.Entry("::1").address(80) == "http://[::1]:80"


@pytest.mark.parametrize("host, reason", [("192.0.2.1", "no address of this machine"), ("no.such.invalid", "no name")])
def test_a_host_that_is_not_here_is_refused(host: str, reason: str) -> None:
    with pytest.raises(OSError, match=f"{reason}.*; choose another --host"):
        display.start_server(0, "mereo", guard.Entry.of(host))
