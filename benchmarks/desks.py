"""Objects found in whole frames of cluttered desks, without a mask.

    desks.py FILE [--objects ...] [--frames 4] [--seed 2000] [--all-places]

Every frame has a table, a wall and four to eight other things, by one camera after the other (the paper's, structured
light, time of flight, stereo), with the object, of which at least 60 % are to be seen, and without it. Each line of
FILE is a frame: what was found at each place, how near it is to the truth, and the time. What FILE has is not made
again.
"""

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from bank import CELLS, registrar_of, scored
from bank_views import OBJECTS, desk_view, scene_of

from mereo.geometry.metrics import truth_grid
from mereo.io.cores import use_threads
from mereo.locating.whole_frame import LOOKS, PlacedAnswer, WholeFrame, answers_in, instances_in
from mereo.synthesis.examples import View

FOUND = 0.75
"""IoU from which on an object is found."""


def answer_desk(name: str, kind: str, number: int, seed: int, all_places: bool) -> dict[str, Any]:
    """Make a desk, look for the object, and say what came of it."""
    rng = np.random.default_rng([seed, *map(ord, f"{name} {kind}"), number])
    seen, view = desk_view(scene_of(name), kind, number, rng)
    registrar = registrar_of(name)
    started = (time.perf_counter(), time.process_time())
    frame = WholeFrame.of(seen, registrar, 1.0)
    answers = list(answers_in(frame, None, most=LOOKS if all_places else 1))
    best = instances_in(frame, answers, False) if answers else []
    places = [facts_of(placed, view) for placed in (*best, *answers)]
    spent = {"seconds": time.perf_counter() - started[0], "processor_s": time.process_time() - started[1]}
    return {"object": name, "kind": kind, "number": number, "seed": seed, **spent, "places": places}


def facts_of(placed: PlacedAnswer, view: View | None) -> dict[str, Any]:
    """What was found at a place, and how near it is to the truth."""
    registration, said = placed.answer.registration, placed.answer.recognition
    assert registration is not None
    facts = {
        "nats": placed.nats,
        "outline": placed.outline._asdict(),
        "believed": placed.is_believed,
        "place": placed.place.outline.nats,
        "known": said.known,
        "signs": said.facts()["signs"],
        "explained": registration.explained,
        "points": len(placed.answer.seen.cloud),
        "z": float(registration.modes_z @ registration.modes_z),
        "modes": registration.model.count,
    }
    if view is not None:
        facts["iou"], facts["miou"] = scored(truth_grid(view.mesh, CELLS), registration.model, registration.material)
    return facts


def best_of(frame: dict[str, Any]) -> dict[str, Any] | None:
    """The answer to a frame, before those of all places."""
    return next(iter(frame["places"]), None)


def show(frames: list[dict[str, Any]]) -> None:
    """Print a table of all frames: how many are found, believed, and wrong."""
    print("object       found   mIoU  right, known  wrong, known  seconds  processor's  without it, known")
    for name in [*dict.fromkeys(frame["object"] for frame in frames), "all"]:
        of = [frame for frame in frames if name in (frame["object"], "all")]
        with_it = [best_of(frame) or {} for frame in of if frame["kind"] == "desk-whole"]
        right = [place for place in with_it if place.get("iou", 0.0) >= FOUND]
        wrong = [place for place in with_it if place.get("iou", 0.0) < FOUND]
        without = [best_of(frame) or {} for frame in of if frame["kind"] == "desk-empty"]
        miou = np.mean([place.get("miou", 0.0) for place in right]) if right else np.nan
        known, believed, empty = (sum(is_known(place) for place in each) for each in (right, wrong, without))
        seconds, processor = (np.median([frame[each] for frame in of]) for each in ("seconds", "processor_s"))
        print(
            f"{name:10} {len(right):>3}/{len(with_it):<3} {miou:6.3f} {known:>7}/{len(right):<5} "
            f"{believed:>7}/{len(wrong):<5} {seconds:8.1f} {processor:12.1f} {empty:>9}/{len(without):<5}"
        )


def is_known(place: dict[str, Any]) -> bool:
    """Whether a place is believed to show the object."""
    return bool(place) and place["believed"]


def main() -> None:
    """Answer what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS), choices=OBJECTS)
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--first", type=int, default=0, help="number of the first frame")
    parser.add_argument("--seed", type=int, default=2000)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--all-places", action="store_true", help="answer at each place, also where one is evident")
    given = parser.parse_args()
    frames = [json.loads(line) for line in given.file.read_text("utf-8").splitlines()] if given.file.is_file() else []
    made = {(frame["object"], frame["kind"], frame["number"], frame["seed"]) for frame in frames}
    wanted = [
        (name, kind, number, given.seed)
        for number in range(given.first, given.first + given.frames)
        for name in given.objects
        for kind in ("desk-whole", "desk-empty")
    ]
    with ProcessPoolExecutor(given.processes, initializer=use_threads, initargs=(1,)) as pool:
        jobs = [pool.submit(answer_desk, *each, given.all_places) for each in wanted if each not in made]
        for job in jobs:
            frames.append(job.result())
            with given.file.open("a", encoding="utf-8") as file:
                file.write(json.dumps(frames[-1], default=float) + "\n")
    show([frame for frame in frames if (frame["object"], frame["kind"], frame["number"], frame["seed"]) in wanted])


if __name__ == "__main__":
    main()
