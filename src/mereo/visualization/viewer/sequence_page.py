"""Page that plays a recorded sequence: the frames, the truth of each, and the answers of a tracker beside it.

The answers are found by a thread of their own, in the order of the frames, as a stream finds them; what is not there
yet is said, and the page never waits.
"""

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from mereo.fitting.registration.register import registrar_for
from mereo.fitting.tracking.tracker import Tracker
from mereo.geometry.mesh import SegmentedMesh
from mereo.models.config import InferenceConfig
from mereo.models.weights_place import load_weights, shipped_names
from mereo.reconstruction.observation import observe
from mereo.synthesis.recording import Recording
from mereo.visualization.viewer import html
from mereo.visualization.viewer.display import (
    Display,
    SegmentControls,
    SegmentLayer,
    import_viser,
    start_server,
)
from mereo.visualization.viewer.guard import Entry
from mereo.visualization.viewer.open_page import OpenPage
from mereo.visualization.viewer.tab_title import tab_title

SHOWN = ("answer", "truth", "side by side")
ASIDE = 1.2
"""Shift of each of two objects side by side, in stage units."""

MOST_HZ = 15.0
"""Pictures a second at most: more do not reach a browser in time."""

Answer = Callable[[int], SegmentedMesh | None]
"""Surfaces of a frame by its number, in metres and the camera frame; None where the object is not found."""


def view_recording(
    recording: Recording, weights: str | None, port: int, host: str, inference: InferenceConfig | None = None
) -> OpenPage:
    """Play a recording; with ``weights``, or those shipped for its scene, the followed object beside the truth.

    Raises ``ImportError`` without the extra `view`, and ``OSError`` for a port that is taken.
    """
    import_viser()
    known = weights or (recording.index.scene if recording.index.scene in shipped_names() else None)
    answer = None if known is None else following(recording, known, inference or InferenceConfig())
    facts = f"{len(recording)} frames, {recording.index.rate_hz:g} Hz · " + (f"weights {known}" if known else "truth")
    entry = Entry.of(host)
    server = start_server(port, tab_title(f"Recording: {recording.index.scene}"), entry)
    return OpenPage(server, entry, SequencePage(server, recording, answer, facts))


def following(recording: Recording, weights: str, inference: InferenceConfig) -> Answer | None:
    """Answers of a tracker, to be asked for in the order of the frames; None for weights without a model."""
    model = load_weights(weights, inference)
    if model.names != tuple(one.name for one in recording.index.segments):
        raise ValueError(
            f"the weights {weights} know the segments {', '.join(model.names)}, and the recording has others: name the "
            "weights of its object with --weights"
        )
    registrar = registrar_for(model, "auto")
    if registrar is None:
        return None
    tracker, unit = Tracker(registrar), recording.index.unit_m

    def answer(number: int) -> SegmentedMesh | None:
        try:
            found = tracker.follow(observe(recording.cloud(number)), recording.times_s[number], scene_unit=unit)
        except (ValueError, OSError):  # a frame that shows nothing; the object may come again
            return None
        return found.surfaces if found.taken else None

    return answer


class SequencePage:
    """Page that plays a recording until ``close``."""

    def __init__(self, server: Any, recording: Recording, answer: Answer | None, facts: str) -> None:
        self.server, self.recording, self.answer = server, recording, answer
        self.answers: list[SegmentedMesh | None] = []
        self._drawing, self._end = threading.Lock(), threading.Event()
        truth = recording.truth(0)
        self.stage = Display(server, self._bounds(), np.array([0.0, -1.0, 0.0]))
        self.found, self.true = SegmentLayer(self.stage, "/found"), SegmentLayer(self.stage, "/true")
        self._build(truth, facts)
        self._draw()
        self.stage.look_from(np.array([0.28, -0.28, -1.0]), self._bounds())
        self._threads = [threading.Thread(target=self._play, daemon=True, name="player")]
        if answer is not None:
            self._threads.append(threading.Thread(target=self._follow, daemon=True, name="follower"))
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop the page's threads; what they are doing is finished."""
        self._end.set()
        for thread in self._threads:
            thread.join()

    def _bounds(self) -> Float[np.ndarray, "2 3"]:
        """Box of the object over the whole sequence, metres."""
        vertices = self.recording.vertices.reshape(-1, 3).astype(np.float64) * self.recording.index.unit_m
        return np.stack([vertices.min(axis=0), vertices.max(axis=0)])

    def _build(self, truth: SegmentedMesh, facts: str) -> None:
        gui, index = self.server.gui, self.recording.index
        gui.add_html(html.heading(f"Recording: {index.scene}", facts))
        gui.add_html(html.chips(truth.names, truth.colors))
        self.playing = gui.add_checkbox("play", True)
        self.number = gui.add_slider("frame", 0, len(self.recording) - 1, 1, 0)
        self.told = gui.add_html(html.message(""))
        has_answer = self.answer is not None
        self.shown = gui.add_dropdown("Show", SHOWN, initial_value=SHOWN[2 if has_answer else 1], visible=has_answer)
        self.points = gui.add_checkbox("observed points", True)
        self.controls = SegmentControls(gui, truth, self._draw)
        for handle in (self.number, self.shown, self.points):
            handle.on_update(lambda _: self._draw())

    # --- threads ------------------------------------------------------------------------------------------------------

    def _play(self) -> None:
        """Move the slider at the recording's pace; draw what it is at."""
        begun, first = time.perf_counter(), 0
        while not self._end.wait(1 / min(MOST_HZ, self.recording.index.rate_hz)):
            if not self.playing.value:
                begun, first = time.perf_counter(), self.number.value
                continue
            passed = (time.perf_counter() - begun) * self.recording.index.rate_hz
            number = int(first + passed) % len(self.recording)
            if number != self.number.value:
                self.number.value = number  # which draws it

    def _follow(self) -> None:
        """Answer all frames in their order."""
        assert self.answer is not None
        for number in range(len(self.recording)):
            if self._end.is_set():
                return
            self.answers.append(self.answer(number))
            if number == self.number.value:
                self._draw()

    # --- drawing ------------------------------------------------------------------------------------------------------

    def _draw(self) -> None:
        """Callbacks and both threads draw; one of them at a time."""
        with self._drawing, self.server.atomic():
            number, mode = int(self.number.value), self.shown.value
            shift = np.array([ASIDE if mode == "side by side" else 0.0, 0.0, 0.0])
            answer = self.answers[number] if number < len(self.answers) else None
            if mode == "answer":
                self.true.clear_from()
            else:
                self.true.show(self.recording.truth(number), self.controls, shift=shift)
            if answer is None or mode == "truth":
                self.found.clear_from()
            else:
                self.found.show(answer, self.controls, shift=-shift)
            self._draw_points(number, -shift)
            self.told.content = html.message(self._words(number, mode))

    def _words(self, number: int, mode: str) -> str:
        time_s = self.recording.times_s[number]
        start, end = self.recording.index.hidden_s
        words = [f"{time_s:.2f} s", *(["something is in front"] if start <= time_s < end else [])]
        if mode != "truth" and self.answer is not None and number >= len(self.answers):
            words.append(f"{len(self.answers)} frames answered, this one is not yet")
        elif mode != "truth" and self.answer is not None and self.answers[number] is None:
            words.append("not found")
        return "; ".join(words + (["answer left, truth right"] if mode == "side by side" else []))

    def _draw_points(self, number: int, shift: Float[np.ndarray, "3"]) -> None:
        try:
            points = self.stage.place(self.recording.cloud(number).points)
        except (ValueError, OSError):  # a frame without a point, or a damaged one
            points = np.zeros((1, 3))
        self.stage.show_points("/cloud", points + shift, self.points.value)
