"""Guard of the viewer's server: pages of its own address are answered, those of others refused with 403.

Any page that a browser shows may open a websocket to 127.0.0.1, and a name that is made to mean 127.0.0.1 (DNS
rebinding) makes the answers readable too. Browsers say in ``Host`` which name they asked for and in ``Origin`` whose
page asks. Programs other than browsers may leave ``Origin`` out, as browsers do when a person opens the page.

Bound to another address than this machine's own, whoever reaches that address could ask. There a request needs the
token of the printed address; a browser gives it once and then as a cookie, since the page's websocket has no query.
"""

import errno
import re
import secrets
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

OWN_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?", re.IGNORECASE)
"""Names of this machine, with any port: a tunnel (``ssh -L``) may end at another one."""


LOOPBACK = "127.0.0.1"
"""Address that only programs of this machine reach."""


@dataclass(frozen=True)
class Entry:
    """Address that a server listens at, and the token that its requests need; "" for none."""

    host: str = LOOPBACK
    token: str = ""

    @classmethod
    def of(cls, host: str) -> "Entry":
        """Entry with a random token, unless the host is this machine's own."""
        return cls(host, "" if host in (LOOPBACK, "localhost", "::1") else secrets.token_urlsafe(24))

    def address(self, port: int) -> str:
        """What to open in a browser."""
        host = socket.gethostname() if self.host in ("0.0.0.0", "::") else self.host  # all of this machine's addresses
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{port}" + (f"/?token={self.token}" if self.token else "")

    def is_token(self, given: str) -> bool:
        """Whether this is the token, in a time that does not depend on where it differs."""
        return secrets.compare_digest(given.encode(errors="replace"), self.token.encode())


def bound_socket(host: str, port: int) -> socket.socket:
    """Socket at an address of this machine, with any free port for 0.

    Raises ``OSError`` where the port is taken, or the host no address of this machine.
    """
    try:
        family, *_, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError):
        raise OSError(f"{host!r} is no name of this machine; choose another --host, or leave it out") from None
    bound = socket.socket(family)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind(place)
    except OSError as error:
        bound.close()
        if error.errno == errno.EADDRNOTAVAIL:
            raise OSError(f"{host} is no address of this machine; choose another --host") from None
        raise OSError(f"port {port} is taken or not allowed; choose another one with --port") from None
    return bound


def refusal(hosts: Sequence[str], origins: Sequence[str], entry: Entry | None = None, given: Sequence[str] = ()) -> str:
    """Reason to refuse a request by its ``Host`` and ``Origin`` headers; empty where it may be answered.

    With an ``entry`` that has a token, any name will do, but one of the tokens ``given`` must be it.
    """
    if entry is not None and entry.token:
        if len(hosts) != 1 or not any(map(entry.is_token, given)):
            return "the address has no token, or another one: open the address that mereo view has printed"
    elif len(hosts) != 1 or not OWN_HOST.fullmatch(hosts[0]):
        return f"the host is {', '.join(hosts) or 'not given'}; it must be 127.0.0.1 or localhost: open that address"
    if any(origin.lower() != f"http://{hosts[0].lower()}" for origin in origins):
        return f"the page is of {', '.join(origins)}; only pages of http://{hosts[0]} are answered: open that address"
    return ""


def _cookie_name(hosts: Sequence[str]) -> str:
    """Name of the cookie; browsers share cookies between the ports of a host."""
    return f"mereo_{urlsplit(f'//{hosts[0]}').netloc.rpartition(':')[2]}" if hosts else ""


def _tokens(path: str, cookies: Sequence[str], name: str) -> tuple[list[str], list[str]]:
    """Tokens in a request's query, and in its cookies."""
    try:
        found = [SimpleCookie(line).get(name) for line in cookies]
    except CookieError:
        found = []
    return parse_qs(urlsplit(path).query).get("token", []), [morsel.value for morsel in found if morsel is not None]


@contextmanager
def guarded_servers(entry: Entry, changed: Callable[[Any], None] | None = None) -> Iterator[list[str]]:
    """Guard every server of ``websockets`` that is started meanwhile; the list holds a word for each.

    ``changed`` may change, in place, what is answered to a request that is let in.

    viser takes no hook for requests, but starts its server by the public ``websockets.asyncio.server.serve``. A caller
    looks into the list, so that another version of viser, which starts it otherwise, is not left without a guard.
    """
    from websockets.asyncio import server

    plain, started = server.serve, list[str]()

    def serve(*arguments: Any, process_request: Callable[[Any, Any], Any] | None = None, **options: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            headers = request.headers
            hosts = headers.get_all("Host")
            queried, kept = _tokens(request.path, headers.get_all("Cookie"), _cookie_name(hosts))
            if reason := refusal(hosts, headers.get_all("Origin"), entry, [*queried, *kept]):
                return connection.respond(HTTPStatus.FORBIDDEN, f"{reason}\n")
            answer = None if process_request is None else process_request(connection, request)
            if answer is not None and changed is not None:
                changed(answer)
            if answer is not None and entry.token and queried:
                answer.headers["Set-Cookie"] = f"{_cookie_name(hosts)}={entry.token}; Path=/; HttpOnly; SameSite=Strict"
                answer.headers["Referrer-Policy"] = "no-referrer"
            return answer

        started.append("guarded")
        return plain(*arguments, process_request=checked, **options)

    server.serve = serve  # type: ignore[assignment, misc]
    try:
        yield started
    finally:
        server.serve = plain  # type: ignore[misc]
