"""Follow an object through a sequence of frames: what ``mereo stream`` does.

frame, time -Tracker.follow-> Result (found, followed or lost)
"""

from concurrent.futures import Executor
from typing import Any

from mereo.api.objects import Object, Source, object_of
from mereo.api.reconstruct import observation_of
from mereo.api.result import Result
from mereo.api.words import python_words
from mereo.fitting import tracking as tracker
from mereo.fitting.config import AnswerMethod
from mereo.reconstruction.config import IsolationConfig


class Tracker:
    """Follow one object through a sequence of frames; not safe for use by several threads at once.

    Each frame is fitted from the last one's state, in milliseconds, also where a hand or a tool hides a part of the
    object. ``Result.tracking`` says how it went:

    - "found": the frame was fitted by itself, as the first one is: by a network, or, without weights, by a search, for
      which it waits some seconds; or it was found again by a search in the background.
    - "followed": the last frame's state led to it.
    - "lost": the object has left the view, is covered, or has moved too far; ``known`` is False and
      ``recognition.reason`` says why. No registration is the answer: ``surfaces`` are a network's, which was asked at
      once but does not explain the frame; without weights they raise ``ValueError``. A search goes on in a thread of
      its own, while frames are answered in milliseconds, until the object is found.

    ``close``, or leaving a ``with`` block, ends that thread.
    """

    def __init__(
        self, object: Object | Source, method: AnswerMethod = "auto", *, executor: Executor | None = None
    ) -> None:
        """Follow an object.

        Args:
            object: from ``load_object``, or whatever that takes.
            method: "auto", or "modes" to take the registered model even where it does not explain the frame.
            executor: what searches for a lost object; by default a thread of the tracker's own.

        Raises ``ValueError`` for other methods, and for weights without a deformation model.
        """
        with python_words():
            registrar = None if method == "network" else object_of(object).registrar(method)
        if registrar is None or method == "full":
            raise ValueError(
                f'the method is {method!r}, and only the modes of a deformation model can be followed: take "auto" '
                "with weights that carry one"
            )
        self._tracker = tracker.Tracker(registrar, executor=executor)

    def follow(self, frame: Any, time_s: float, *, isolation: IsolationConfig | None = None, **reading: Any) -> Result:
        """Find the object in the next frame.

        Args:
            frame: whatever ``load_frame`` takes, or what it has returned; in one unit throughout the sequence.
            time_s: of the frame, seconds from any zero, later than the last one's.
            isolation: what of the frame is left out.
            reading: arguments of ``load_frame``.

        Raises ``ValueError`` for unusable frames, after which the sequence may go on. Surfaces, labels and figures are
        made when they are asked for.
        """
        isolation = isolation or IsolationConfig()
        with python_words():
            seen = observation_of(frame, isolation, reading)
            return Result.of(self._tracker.follow(seen, time_s, keep_all=isolation.keep_all))

    def forget(self) -> None:
        """Start again: the next frame is fitted by itself; a search that goes on is given up."""
        self._tracker.forget()

    def close(self) -> None:
        """Give up a search that goes on, and wait until its thread has ended, for seconds at most."""
        self._tracker.close()

    def __enter__(self) -> "Tracker":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
