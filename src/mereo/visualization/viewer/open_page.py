"""Page of the viewer that is open: its address, waiting for Ctrl-C, closing it, and showing it in a notebook."""

import gc
import sys
import threading
from html import escape
from typing import Any, Protocol, runtime_checkable

from mereo.visualization.viewer.display import stop_server
from mereo.visualization.viewer.guard import Entry

FRAME_PX = 560
"""Height of the page within a notebook."""


COLLECT_EVERY_S = 5.0
"""Time between two collections of what closed pages leave behind."""


@runtime_checkable
class Closing(Protocol):
    """Page with threads of its own, which end with it."""

    def close(self) -> None:
        """Stop them."""
        ...


class OpenPage:
    """Page of the viewer, open until ``close``; also a context, which closes it at its end.

    Attributes:
        address: what to open in a browser.
    """

    def __init__(self, server: Any, entry: Entry, page: Closing | None = None) -> None:
        self._server, self._page = server, page
        self._closed = False
        self.address = entry.address(server.get_port())

    def stay(self, block: bool | None = None) -> "OpenPage":
        """Print the address; then wait until Ctrl-C and close, or with ``block`` False return at once.

        By default it waits everywhere but in a notebook or an interactive session.
        """
        block = not is_interactive() if block is None else block
        print(f"open {self.address} in a browser; {'Ctrl-C ends' if block else 'close() ends'}", flush=True)
        if block:
            self.wait()
        return self

    def wait(self) -> None:
        """Wait until Ctrl-C, and close."""
        try:
            keep_open(threading.Event())
        except KeyboardInterrupt:
            print("closed")
        finally:
            self.close()

    def close(self) -> None:
        """Close the page for all browsers; once is enough."""
        if self._closed:
            return
        self._closed = True
        if self._page is not None:
            self._page.close()
        stop_server(self._server)

    def __enter__(self) -> "OpenPage":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"OpenPage({'closed' if self._closed else self.address!r})"

    def _repr_html_(self) -> str:
        """The page in a frame; a notebook of another machine cannot reach it and shows the address."""
        if self._closed:
            return "<p>closed</p>"
        address = escape(self.address)
        frame = f'<iframe src="{address}" width="100%" height="{FRAME_PX}" style="border:0"></iframe>'
        return f'{frame}<p>or open <a href="{address}">{address}</a>; <code>close()</code> ends</p>'


def keep_open(end: threading.Event) -> None:
    """Wait for the end, and collect meanwhile what pages leave behind that were closed.

    viser keeps the exception that says so beside the task that raised it (``ws_handler``), and with that cycle the
    page's buffers, about 0.4 MB. CPython collects cycles that have grown old only after a quarter of all objects known
    at the last full collection have come new: of the 400,000 of the libraries and the model. Those are put aside
    (``gc.freeze``), which makes a full collection of the others a matter of a millisecond.
    """
    gc.collect()
    gc.freeze()
    try:
        while not end.wait(COLLECT_EVERY_S):
            gc.collect()
    finally:
        gc.unfreeze()


def is_interactive() -> bool:
    """Whether this is a notebook or an interactive session, which goes on after a line."""
    asked = getattr(sys.modules.get("IPython"), "get_ipython", None)
    return hasattr(sys, "ps1") or bool(sys.flags.interactive) or (asked is not None and asked() is not None)
