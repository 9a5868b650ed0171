"""Page of an answer that is there already: what ``Result.show`` opens."""

from mereo.fitting.registration.answer import Answer
from mereo.visualization.units import Unit
from mereo.visualization.viewer.display import import_viser, start_server
from mereo.visualization.viewer.frame_page import FramePage
from mereo.visualization.viewer.guard import Entry
from mereo.visualization.viewer.open_page import OpenPage
from mereo.visualization.viewer.panels import DepthPicture
from mereo.visualization.viewer.probe import Inspection
from mereo.visualization.viewer.tab_title import tab_title


def open_answer(answer: Answer, *, port: int, host: str) -> OpenPage:
    """Page of an answer, on the frame that it was given to.

    Raises ``ImportError`` without the extra `view`, and ``OSError`` for a port that is taken.
    """
    import_viser()
    seen = answer.seen
    inspection = Inspection.of_answer(answer)
    entry = Entry.of(host)
    server = start_server(port, tab_title(seen.frame.source), entry)
    made_with = "no weights" if answer.model is None else f"weights {answer.model.name or 'of this program'}"
    facts = f"{len(seen.cloud):,} points · {made_with}"
    unit = Unit(seen.frame.unit_m)
    FramePage(server, inspection, seen.frame.source, facts, unit, DepthPicture.of(seen.frame.depth, unit))
    return OpenPage(server, entry)
