"""Server of the viewer's pages, which this machine alone reaches, and a page of it that is open.

From another machine a page is opened through a tunnel: ``ssh -L 8080:127.0.0.1:8080``.
"""

import contextlib
import io
import logging
import re
import socket
import sys
import threading
from collections.abc import Iterator
from html import escape
from typing import Any

import numpy as np

LOOPBACK = "127.0.0.1"
"""Address that only programs of this machine reach."""

PORT = 8080
"""Port of a page that is waited for, where none is chosen."""

LOCAL_PAGES = re.compile(r"http://(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?")
"""Origins of pages that may connect; with any port, because a tunnel may end at another one."""

# --- server -----------------------------------------------------------------------------------------------------------


def import_viser() -> Any:
    """Module of viser; raises ``ImportError`` with a sentence on how to get it."""
    try:
        import viser
    except ImportError:
        raise ImportError("viser is not installed; `mereo view` needs it: run pip install 'mereo[view]'") from None
    return viser


def start_server(port: int) -> Any:
    """Start a server of viser, without pages, at a port of this machine; 0 takes any that is free.

    Raises ``OSError`` where the port is taken, and ``ImportError`` for a viser that starts its server in another way.
    """
    viser = import_viser()
    port = free_port(port)  # viser would silently take another one
    # browsers open connections ahead and drop them, which websockets reports with a traceback each
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    with contextlib.redirect_stdout(io.StringIO()), local_pages_only() as checked:  # without viser's banner
        server = viser.ViserServer(host=LOOPBACK, port=port, label="mereo", verbose=False)
    if not checked:
        stop_server(server)
        raise ImportError(
            f"viser {viser.__version__} starts its server in a way that mereo cannot close to other web pages: run "
            "pip install 'viser==1.1.1'"
        )
    server.gui.configure_theme(
        dark_mode=True, show_logo=False, show_share_button=False, control_width="medium", brand_color=(86, 180, 233)
    )
    server.gui.main_panel.float(x=15, y=15, width=300)
    # neutral and dark, as the palette's yellow is hard to see on white, with a share of viser's surrounding light, in
    # all of which the palette's colours would fade to white
    share = np.linspace(0.0, 1.0, 256)[:, None, None]
    backdrop = np.array((58, 65, 78)) * (1 - share) + np.array((22, 25, 32)) * share
    server.scene.set_background_image(np.broadcast_to(backdrop, (256, 8, 3)).astype(np.uint8), format="png")
    server.scene.configure_default_lights(cast_shadow=False)
    server.scene.configure_environment_map(environment_intensity=0.45)
    return server


def stop_server(server: Any) -> None:
    """Close all pages; without the line that viser prints."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def free_port(port: int) -> int:
    """Port of this machine that can be listened at, any free one for 0; raises ``OSError`` where it is taken."""
    with socket.socket() as probe:
        if sys.platform != "win32":  # Windows would share a port that is taken
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError:
            raise OSError(f"port {port} is taken or not allowed; choose another one with --port") from None
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def local_pages_only() -> Iterator[list[str]]:
    """Let websocket servers that are started meanwhile refuse pages of other addresses; the list has a word for each.

    Browsers let any page open a websocket to 127.0.0.1, also under a name that is made to mean it (DNS rebinding), and
    viser, which has no option for this, sends every one the whole scene. All data pass through the websocket, whose
    ``Origin`` the library that viser starts it with can check. Programs other than browsers send none.
    """
    from websockets.asyncio import server

    serve = server.serve
    checked = list[str]()

    def serve_local_pages(*arguments: Any, **options: Any) -> Any:
        checked.append("checked")
        return serve(*arguments, origins=[LOCAL_PAGES, None], **options)

    server.serve = serve_local_pages  # type: ignore[assignment, misc]
    try:
        yield checked
    finally:
        server.serve = serve  # type: ignore[misc]


# --- open page --------------------------------------------------------------------------------------------------------


class OpenPage:
    """Page of the viewer, open until ``close``; also a context, which closes it at its end.

    Attributes:
        address: what to open in a browser.
    """

    def __init__(self, server: Any) -> None:
        self._server, self._closed = server, False
        self.address = f"http://{LOOPBACK}:{server.get_port()}"

    def stay(self, block: bool | None = None) -> "OpenPage":
        """Print the address; then wait until Ctrl-C and close, or with ``block`` False return at once.

        By default it waits everywhere but in a notebook or an interactive session.
        """
        block = not is_interactive() if block is None else block
        print(f"open {self.address} in a browser; {'Ctrl-C ends' if block else 'close() ends'}", flush=True)
        if block:
            try:
                threading.Event().wait()
            except KeyboardInterrupt:
                print("closed")
            finally:
                self.close()
        return self

    def close(self) -> None:
        """Close the page for all browsers; once is enough."""
        if not self._closed:
            self._closed = True
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
        frame = f'<iframe src="{address}" width="100%" height="560" style="border:0"></iframe>'
        return f'{frame}<p>or open <a href="{address}">{address}</a>; <code>close()</code> ends</p>'


def is_interactive() -> bool:
    """Whether this is a notebook or an interactive session, which goes on after a line."""
    ipython = getattr(sys.modules.get("IPython"), "get_ipython", None)
    return hasattr(sys, "ps1") or bool(sys.flags.interactive) or (ipython is not None and ipython() is not None)
