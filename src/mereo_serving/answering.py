"""The process that answers: frames are read, answered and written one by one.

    FrameRequest -read, isolate-> Observation -reconstruct-> Result -write-> Reply

A reply is summary.json or segments.glb, as ``mereo reconstruct`` writes them. Whatever goes wrong with a frame is its
own ``Reply``; nothing is raised for it.
"""

import json
import logging
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, cast

from mereo.api.objects import Object, load_object, load_weights, object_of
from mereo.api.reconstruct import reconstruct_observation
from mereo.api.result import Result
from mereo.api.words import option_words
from mereo.fitting.config import AnswerMethod
from mereo.fitting.registration.register import Registrar
from mereo.io.atomic_files import to_json
from mereo.io.errors import SizeError, is_foreseen, words_of
from mereo.io.sensor_frame import read_frame
from mereo.io.writers.glb import viewer_rotation, write_segments_glb
from mereo.models.config import Precision
from mereo.models.trained import Trained
from mereo.reconstruction.observation import find_object
from mereo.visualization.result_files import radii_of, summary_of
from mereo_serving.messages import FAULT, JSON, FrameRequest, Ready, Reply, Served, Setup, failed

LOG = logging.getLogger("mereo_serving")


@dataclass(frozen=True, eq=False)
class Loaded:
    """Object that is ready.

    Attributes:
        served: as it is served.
        object: with its network, if it has one, on its device, known by the name that clients use.
        method: who answers.
    """

    served: Served
    object: Object
    method: AnswerMethod

    @classmethod
    def of(cls, served: Served, setup: Setup) -> "Loaded":
        """Load an object, and make what every frame needs; raises as ``load_object`` and ``registrar_for`` do."""
        if served.weights is None:
            target = load_object(served.object)
        else:
            network: Any = load_weights(served.weights, setup.inference)
            network = replace(network, name=served.name)
            _ = network.inference  # made ready for the first question
            target = load_object(network, served.scene)
        loaded = cls(served, target, setup.method)
        registrar = loaded.registrar
        if registrar is not None:
            registrar.prepare()
        return loaded

    @property
    def model(self) -> Trained | None:
        """The network, where there is one."""
        return self.object.network

    @property
    def registrar(self) -> Registrar | None:
        """Registrar of the object's own model; None where the network alone answers."""
        return self.object.registrar(self.method)

    def facts(self) -> dict[str, Any]:
        """What clients may know of the object."""
        model, known = self.model, self.object.segments
        frame = None if self.registrar is None else self.registrar.model.source_frame
        return {
            "name": self.served.name,
            "segments": [
                {"name": name, "label": number + 1, "color": list(color)}
                for number, (name, color) in enumerate(zip(known.names, known.colors, strict=True))
            ],
            "nested": [list(pair) for pair in known.nested],
            "scene": self.object.name if model is None else model.provenance.get("scene"),
            "method": "network" if self.registrar is None else self.registrar.method,
            "scene_unit_m": None if frame is None else frame.unit_m,
            "calibrated": model is not None and model.calibrates,
            "device": None if model is None else model.device_type,
            "precision": None if model is None else model.working_precision,
        }


@dataclass(eq=False)
class Answerer:
    """Answers frames, one after the other.

    Attributes:
        setup: what is served.
        loaded: the objects, by name.
    """

    setup: Setup
    loaded: dict[str, Loaded] = field(default_factory=dict)

    @classmethod
    def of(cls, setup: Setup) -> "Answerer":
        """Load all weights; raises ``ValueError`` or ``OSError`` where some cannot be served so."""
        return cls(setup, {item.name: Loaded.of(item, setup) for item in setup.served})

    def ready(self) -> Ready:
        """What is reported first."""
        facts = tuple(item.facts() for item in self.loaded.values())
        settled = [item.model.working_precision for item in self.loaded.values() if item.model is not None]
        return Ready(facts, cast(Precision, settled[0]) if settled else "float32")

    def __call__(self, frame: FrameRequest) -> Reply:
        """Answer to a frame, or why there is none."""
        try:
            return self._answer(frame)
        except Exception as error:
            return refusal(error, frame)

    def _answer(self, frame: FrameRequest) -> Reply:
        started = time.perf_counter()
        messages = list[str]()
        loaded = self.loaded[frame.weights]
        with option_words(), taken_warnings(messages, frame):
            read = read_frame(frame.path, frame.reading)
            if len(read.cloud) > self.setup.max_points:
                raise SizeError(
                    f"{frame.file} has {len(read.cloud)} points; at most {self.setup.max_points} are answered here: "
                    "thin it out, or crop it around the object"
                )
            seen = find_object(read, frame.isolation)
            read_s = time.perf_counter() - started
            known = object_of(loaded.object, frame.joints)
            result = reconstruct_observation(
                seen, known, loaded.method, resolution=frame.resolution, isolation=frame.isolation
            )
        started = time.perf_counter()
        body = json_of(result, messages) if frame.media == JSON else glb_of(result, frame)
        seconds = {"read": read_s, **result.reconstruction.timings_s, "write": time.perf_counter() - started}
        headers = {
            "Mereo-Known": str(result.known).lower(),
            "Mereo-Answer": "network" if result.pose is None else "registration",
        }
        return Reply(200, body, frame.media, headers, seconds)


def json_of(result: Result, warned: list[str]) -> bytes:
    """Content of summary.json, and what was warned of."""
    return json.dumps(to_json({**summary_of(result), "warnings": warned}), ensure_ascii=False, allow_nan=False).encode()


def glb_of(result: Result, request: FrameRequest) -> bytes:
    """Content of segments.glb."""
    frame = result.seen.frame
    path = request.folder / "segments.glb"
    to_viewer = viewer_rotation(frame.axes)
    radii = radii_of(result.registered)
    write_segments_glb(path, result.reconstruction.surfaces, to_viewer, frame.metres, radii)
    return path.read_bytes()


def refusal(error: Exception, frame: FrameRequest) -> Reply:
    """Reply that a frame cannot be answered: with the sentence of the command line where it is the client's to mend."""
    if not (is_foreseen(error) and isinstance(error, ValueError | ImportError)):
        LOG.error("a frame of %s cannot be answered", frame.weights, exc_info=error)
        return failed(500, FAULT)
    status = 413 if isinstance(error, SizeError) else 415 if isinstance(error, ImportError) else 422
    return failed(status, shown(words_of(error), frame))


def shown(text: str, frame: FrameRequest) -> str:
    """Text in one line, in which files are called by their names alone."""
    return " ".join(text.replace(f"{frame.folder}/", "").split())


@contextmanager
def taken_warnings(warned: list[str], frame: FrameRequest) -> Iterator[None]:
    """Take mereo's own warnings of the block for the client; others are passed on."""
    with warnings.catch_warnings(record=True) as recorded:
        warnings.simplefilter("always")
        yield
    for warning in recorded:
        if warning.category.__module__.startswith("mereo"):
            warned.append(shown(str(warning.message), frame))
        else:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
