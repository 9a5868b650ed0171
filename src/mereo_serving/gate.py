"""Before every request: whose it is, and after it: its number; and bodies that nobody reads.

On this machine's own address requests must name it (a page of another host could ask too, and a name can be made to
mean 127.0.0.1, DNS rebinding), on another one they need the token. Browsers say in ``Host`` which name they asked for
and in ``Origin`` whose page asks; other programs may leave ``Origin`` out.
"""

import asyncio
import errno
import re
import secrets
import socket
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qsl, urlencode

from mereo_serving.messages import failed
from mereo_serving.metrics import OTHER, Metrics

PROBES = ("/healthz", "/readyz")
"""Addresses that tell nothing, and that supervisors ask without a token."""

DRAINED_S = 2.0
"""Seconds for which a body is still taken that is refused: a client that sends cannot read why."""


LOCAL_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?", re.IGNORECASE)
"""Names of this machine, with any port: a tunnel (``ssh -L``) may end at another one."""


NO_TOKEN = "there is no token, or another one; send that of the printed address: Authorization: Bearer TOKEN"

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
    if sys.platform != "win32":  # a port in use a minute ago will do; Windows would share a taken one
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind(place)
    except OSError as error:
        bound.close()
        if error.errno == errno.EADDRNOTAVAIL:
            raise OSError(f"{host} is no address of this machine; choose another --host") from None
        raise OSError(f"port {port} is taken or not allowed; choose another one with --port") from None
    return bound


def refusal(hosts: Sequence[str], origins: Sequence[str], any_host: bool) -> str:
    """Reason to refuse a request by its ``Host`` and ``Origin`` headers; empty where it may be answered."""
    if len(hosts) != 1 or not (any_host or LOCAL_HOST.fullmatch(hosts[0])):
        return f"the host is {', '.join(hosts) or 'not given'}; it must be 127.0.0.1 or localhost: open that address"
    if any(origin.lower() != f"http://{hosts[0].lower()}" for origin in origins):
        return f"the page is of {', '.join(origins)}; only pages of http://{hosts[0]} are answered: open that address"
    return ""


class Gate:
    """ASGI application around another one.

    Args:
        app: what answers.
        entry: the address, and its token.
        metrics: that count.
        most: bytes of a refused body that are still taken.
    """

    def __init__(self, app: Any, entry: Entry, metrics: Metrics, most: int) -> None:
        self.app, self.entry, self.metrics, self.most = app, entry, metrics, most

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Answer a request of the server."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        started = time.perf_counter()
        code = 499
        body = _Body(scope, receive)

        async def answer(message: Any) -> None:
            nonlocal code
            if message["type"] == "http.response.start":
                code = message["status"]
                await body.drain(self.most)
            await send(message)

        try:
            if refused := self._refused(scope):
                await _respond(answer, *refused)
            else:
                await self.app(scope, body.receive, answer)
        finally:
            endpoint = getattr(scope.get("route"), "path", OTHER)
            self.metrics.answered(endpoint, code, time.perf_counter() - started)

    def _refused(self, scope: Any) -> tuple[int, str] | None:
        """Status and sentence for a request that may not be answered; the token leaves the query."""
        headers = [(name.lower(), value.decode("latin-1")) for name, value in scope["headers"]]
        queried = parse_qsl(scope["query_string"].decode("latin-1"), keep_blank_values=True)
        given = [value for name, value in queried if name == "token"]
        if given:
            scope["query_string"] = urlencode([pair for pair in queried if pair[0] != "token"]).encode()
        bearers = [value.partition(" ") for name, value in headers if name == b"authorization"]
        given += [token.strip() for scheme, _, token in bearers if scheme.lower() == "bearer"]
        if self.entry.token and not any(map(self.entry.is_token, given)):
            if scope["path"] in PROBES:
                return None
            return 401, NO_TOKEN
        hosts, origins = ([value for name, value in headers if name == key] for key in (b"host", b"origin"))
        reason = refusal(hosts, origins, bool(self.entry.token))
        return (403, reason) if reason else None


class _Body:
    """Body of a request, of which it is known whether all of it has come."""

    def __init__(self, scope: Any, receive: Any) -> None:
        self._receive, self._whole = receive, False
        # a client that waits for leave to send a body gets the answer instead
        self._expects_continue = any(name.lower() == b"expect" for name, _ in scope["headers"])

    async def receive(self) -> Any:
        message = await self._receive()
        self._whole = self._whole or message["type"] != "http.request" or not message.get("more_body", False)
        return message

    async def drain(self, most: int) -> None:
        """Take what is left of the body, for a while."""
        try:
            async with asyncio.timeout(DRAINED_S):
                while most > 0 and not self._whole and not self._expects_continue:
                    most -= len((await self.receive()).get("body", b""))
        except TimeoutError:
            return


async def _respond(send: Any, status: int, sentence: str) -> None:
    reply = failed(status, sentence)
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(reply.body)).encode())]
    if status == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": reply.body})
