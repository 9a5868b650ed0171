"""Before every request: whose it is, and after it: its number; and bodies that nobody reads.

The rules are those of the viewer (``visualization.viewer.guard``): on this machine's own address requests must name it
(a page of another host could ask too, and DNS can be made to lie), on another one they need the token.
"""

import asyncio
import time
from typing import Any
from urllib.parse import parse_qsl, urlencode

from mereo.visualization.viewer.guard import Entry, refusal
from mereo_serving.metrics import OTHER, Metrics
from mereo_serving.refusals import failed

PROBES = ("/healthz", "/readyz")
"""Addresses that tell nothing, and that supervisors ask without a token."""

DRAINED_S = 2.0
"""Seconds for which a body is still taken that is refused: a client that sends cannot read why."""


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
        started, code, body = time.perf_counter(), 499, _Body(scope, receive)

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
        hosts = [value for name, value in headers if name == b"host"]
        origins = [value for name, value in headers if name == b"origin"]
        queried = parse_qsl(scope["query_string"].decode("latin-1"), keep_blank_values=True)
        given = [value for name, value in queried if name == "token"]
        if given:
            rest = [(name, value) for name, value in queried if name != "token"]
            scope["query_string"] = urlencode(rest).encode()
        for name, value in headers:
            scheme, _, token = value.partition(" ")
            if name == b"authorization" and scheme.lower() == "bearer":
                given.append(token.strip())
        if self.entry.token and not any(map(self.entry.is_token, given)):
            if scope["path"] in PROBES:
                return None
            return (
                401,
                "there is no token, or another one; send that of the printed address: Authorization: Bearer TOKEN",
            )
        reason = refusal(hosts, origins, self.entry, given)
        return (403, reason) if reason else None


class _Body:
    """Body of a request, of which it is known whether all of it has come."""

    def __init__(self, scope: Any, receive: Any) -> None:
        self._receive, self._whole = receive, False
        # who waits for leave to send a body is told the answer instead
        self._asked = any(name.lower() == b"expect" for name, _ in scope["headers"])

    async def receive(self) -> Any:
        message = await self._receive()
        self._whole = self._whole or message["type"] != "http.request" or not message.get("more_body", False)
        return message

    async def drain(self, most: int) -> None:
        """Take what is left of the body, for a while."""
        try:
            async with asyncio.timeout(DRAINED_S):
                while most > 0 and not self._whole and not self._asked:
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
