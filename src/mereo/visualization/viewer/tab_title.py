"""Title of the browser's tab: viser's page is called "Viser" whatever it shows, and has no option for it."""

import gzip
import re
from collections.abc import Callable
from html import escape
from typing import Any

PROGRAM = "mereo"
TITLE = re.compile(rb"<title>[^<]*</title>")


def tab_title(shown: str) -> str:
    """Title of a page that shows this: several pages are told apart by it."""
    return f"{shown} · {PROGRAM}"


def titling(title: str) -> Callable[[Any], None]:
    """What puts a title into answers of viser's server that are its page, in place, and leaves all others alone.

    The page is one file of 0.8 MB, so it is changed once for each encoding.
    """
    done: dict[str, bytes] = {}

    def entitle(answer: Any) -> None:
        if not answer.headers.get("Content-Type", "").startswith("text/html") or not answer.body:
            return
        encoding = answer.headers.get("Content-Encoding", "identity")
        if encoding not in ("identity", "gzip"):
            return
        if encoding not in done:
            page = gzip.decompress(answer.body) if encoding == "gzip" else bytes(answer.body)
            named = TITLE.sub(lambda _: f"<title>{escape(title)}</title>".encode(errors="replace"), page, count=1)
            done[encoding] = gzip.compress(named) if encoding == "gzip" else named
        answer.body = done[encoding]
        del answer.headers["Content-Length"]
        answer.headers["Content-Length"] = str(len(answer.body))

    return entitle
