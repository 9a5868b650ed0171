"""``mereo stream``: a reconstruction of the latest frame, again and again."""

import json
import re
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from mereo.io.config import InputConfig
from mereo.io.scratch_folders import check_place
from mereo.io.writers.glb import viewer_rotation, write_segments_glb
from mereo.models.config import InferenceConfig
from mereo.models.weights import load_for
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.pipeline import Reconstruction, reconstruct
from mereo.reconstruction.stream import Counter, Outcome, Summary, stream
from mereo.reconstruction.stream_sources import STANDARD_INPUT, frames_of


def stream_reconstructions(
    source: str,
    weights: str,
    *,
    resolution: int = 48,
    rate_hz: float = 30.0,
    every_frame: bool = False,
    surfaces: Path | None = None,
    reading: InputConfig | None = None,
    isolation: IsolationConfig | None = None,
    inference: InferenceConfig | None = None,
) -> Summary:
    """Print a line of JSON for each answered or bad frame, and the summary at the end or after Ctrl-C.

    Raises ``ValueError`` where not one frame could be answered.
    """
    if surfaces is not None:
        check_place(surfaces, may_be_link=True)
    reading, isolation = reading or InputConfig(), isolation or IsolationConfig()
    model = load_for(weights, inference or InferenceConfig())
    frames = frames_of(source, reading, isolation, rate_hz)
    answer = partial(reconstruct, model=model, resolution=resolution, frame=reading.frame)
    # what is written to standard input arrives when it does
    pace = not every_frame and source != STANDARD_INPUT
    outcomes: Iterator[Outcome[Reconstruction]] = stream(frames, answer, recorded_pace=pace, every_frame=every_frame)
    counter, last_error = Counter(), ""
    to_viewer = viewer_rotation(reading.frame)
    try:
        for outcome in outcomes:
            counter.add(outcome)
            last_error = outcome.error or last_error
            print(json.dumps(line(outcome)), flush=True)
            if surfaces is not None and outcome.result is not None:
                surfaces.mkdir(parents=True, exist_ok=True)
                name = re.sub(r"[^\w.-]+", "_", outcome.name)
                write_segments_glb(surfaces / f"{name}.glb", outcome.result.surfaces, to_viewer)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
    summary = counter.summary()
    print(summary, file=sys.stderr)
    if not summary.answered and last_error:
        raise ValueError(f"none of the {summary.failed} frames could be answered; the last one: {last_error}")
    return summary


def line(outcome: Outcome[Reconstruction]) -> dict[str, Any]:
    """JSON that is printed of one frame; lengths in the input's unit, times in milliseconds."""
    facts: dict[str, Any] = {
        "frame": outcome.name,
        "time_s": outcome.time_s,
        "latency_ms": round(1e3 * outcome.latency_s, 1),
        "work_ms": round(1e3 * outcome.work_s, 1),
        "dropped": outcome.dropped,
    }
    if outcome.result is None:
        return {**facts, "error": outcome.error}
    found = {
        segment.name: {
            "centroid": [round(float(value), 6) for value in segment.centroid],
            "volume": float(segment.volume),
            "confidence": round(float(segment.confidence), 3),
        }
        for segment in outcome.result.segments
        if segment.voxels
    }
    return {**facts, "segments": found}
