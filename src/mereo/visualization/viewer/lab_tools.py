"""Tools beside the sliders of the laboratory: a state as text, films, and what can be taken home."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mereo.io.foreseen import words_of
from mereo.visualization.renderer import Viewpoint
from mereo.visualization.viewer.film import MOST_FRAMES, Film, viewpoint
from mereo.visualization.viewer.lab_stage import Moment
from mereo.visualization.viewer.laboratory import Laboratory
from mereo.visualization.viewer.saving import file_name, frame_archive, result_archive


@dataclass(frozen=True)
class Ties:
    """What the tools need of their page.

    Attributes:
        say: tells a sentence, as an error or not.
        moment: what is shown.
        take: shows the state that a text says; raises ``ValueError`` where it says none.
        walk: sets out on a walk through states.
    """

    say: Callable[[str, bool], None]
    moment: Callable[[], Moment | None]
    take: Callable[[str], None]
    walk: Callable[[], None]


class LabTools:
    """Folders of the panel for a state as text, for films and for downloads."""

    def __init__(self, server: Any, laboratory: Laboratory, ties: Ties) -> None:
        self.server, self.laboratory, self.ties = server, laboratory, ties
        self._filming = threading.Lock()
        self.film: Film | None = None
        gui = server.gui
        with gui.add_folder("State as text", expand_by_default=False):
            hint = "The state that is shown. Copy it; or paste another one, or the content of a state.json, over it."
            self.text = gui.add_text("", "", multiline=True, hint=hint)
            gui.add_button("Show the pasted state").on_click(lambda _: self._try(self._take))
        with gui.add_folder("Record", expand_by_default=False):
            gui.add_button("Walk through states").on_click(lambda _: ties.walk())
            self._recording = gui.add_button("Record a GIF")
            self._recording.on_click(lambda event: self._try(lambda: self.switch_recording(event.client)))
        with gui.add_folder("Save", expand_by_default=False):
            gui.add_button("Frame (.zip)").on_click(lambda event: self._try(lambda: self.save_frame(event.client)))
            button = gui.add_button("Result (.zip)", visible=laboratory.model is not None)
            button.on_click(lambda event: self._try(lambda: self.save_result(event.client)))

    def _try(self, act: Callable[[], None]) -> None:
        """Do what a hand has asked for; what goes wrong is told on the page, which lives on."""
        try:
            act()
        except Exception as error:
            self.ties.say(words_of(error), True)

    # --- states -------------------------------------------------------------------------------------------------------

    def show_text(self, text: str) -> None:
        """Bring the box to the state that is shown."""
        if self.text.value != text:
            self.text.value = text

    def _take(self) -> None:
        self.ties.take(str(self.text.value))

    # --- films --------------------------------------------------------------------------------------------------------

    def switch_recording(self, client: Any) -> None:
        """Begin a film from where a browser looks; or end it, and hand it out."""
        with self._filming:
            film, self.film = self.film, None
            if film is None:
                self.film = Film(self._viewpoint(client))
                self._tell_film(self.film)
                return
            self._recording.label = "Record a GIF"
        self._send(client, file_name(self.laboratory.scene, "film.gif"), film.gif())

    def shoot(self, draw: Callable[[Film], None]) -> None:
        """Let a film that is going on have its next picture."""
        with self._filming:
            if self.film is not None and not self.film.is_full:
                draw(self.film)
                self._tell_film(self.film)

    def _tell_film(self, film: Film) -> None:
        self._recording.label = f"Stop ({len(film)} of {MOST_FRAMES} pictures)"

    def _viewpoint(self, client: Any) -> Viewpoint:
        camera = self.server.initial_camera if client is None else client.camera
        up = camera.up if client is None else camera.up_direction
        place, target, up = (np.array(value, dtype=float) for value in (camera.position, camera.look_at, up))
        return viewpoint(place, target, up, float(camera.fov))

    # --- downloads ----------------------------------------------------------------------------------------------------

    def save_frame(self, client: Any) -> None:
        """Hand out the depth image that is shown, with its camera, and as a cloud."""
        view = self._shown().view
        self._send(client, file_name(self.laboratory.scene, "frame.zip"), frame_archive(self.laboratory.scene, view))

    def save_result(self, client: Any) -> None:
        """Hand out what `mereo reconstruct` would write of the frame."""
        view, scene = self._shown().view, self.laboratory.scene
        self.ties.say("writing the result", False)
        self._send(client, file_name(scene, "result.zip"), result_archive(scene, self.laboratory.answer(view)))

    def _shown(self) -> Moment:
        moment = self.ties.moment()
        if moment is None:
            raise ValueError("nothing is shown yet: wait for it, then save it")
        return moment

    def _send(self, client: Any, name: str, content: bytes) -> None:
        """Start a browser's download, which gives it a name of its own where there is a file of this one."""
        if client is None:
            raise ValueError(f"{name} was asked for by no browser")
        client.send_file_download(name, content, save_immediately=True)
        self.ties.say(f"{name}, {len(content) / 1e6:.2g} MB, is among your browser's downloads", False)
