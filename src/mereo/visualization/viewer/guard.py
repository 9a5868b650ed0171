"""Guard of the viewer's server: pages of its own address are answered, those of others refused with 403.

Any page that a browser shows may open a websocket to 127.0.0.1, and a name that is made to mean 127.0.0.1 (DNS
rebinding) makes the answers readable too. Browsers say in ``Host`` which name they asked for and in ``Origin`` whose
page asks. Programs other than browsers may leave ``Origin`` out, as browsers do when a person opens the page.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

OWN_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?", re.IGNORECASE)
"""Names of this machine, with any port: a tunnel (``ssh -L``) may end at another one."""


def refusal(hosts: Sequence[str], origins: Sequence[str]) -> str:
    """Reason to refuse a request by its ``Host`` and ``Origin`` headers; empty where it may be answered."""
    if len(hosts) != 1 or not OWN_HOST.fullmatch(hosts[0]):
        return f"the host is {', '.join(hosts) or 'not given'}; it must be 127.0.0.1 or localhost: open that address"
    if any(origin.lower() != f"http://{hosts[0].lower()}" for origin in origins):
        return f"the page is of {', '.join(origins)}; only pages of http://{hosts[0]} are answered: open that address"
    return ""


@contextmanager
def guarded_servers() -> Iterator[list[str]]:
    """Guard every server of ``websockets`` that is started meanwhile; the list holds a word for each.

    viser takes no hook for requests, but starts its server by the public ``websockets.asyncio.server.serve``. A caller
    looks into the list, so that another version of viser, which starts it otherwise, is not left without a guard.
    """
    from websockets.asyncio import server

    plain, started = server.serve, list[str]()

    def serve(*arguments: Any, process_request: Callable[[Any, Any], Any] | None = None, **options: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            headers = request.headers
            if reason := refusal(headers.get_all("Host"), headers.get_all("Origin")):
                return connection.respond(HTTPStatus.FORBIDDEN, f"{reason}\n")
            return None if process_request is None else process_request(connection, request)

        started.append("guarded")
        return plain(*arguments, process_request=checked, **options)

    server.serve = serve  # type: ignore[assignment, misc]
    try:
        yield started
    finally:
        server.serve = plain  # type: ignore[misc]
