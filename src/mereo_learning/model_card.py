"""Released weights, at half the size, with a card that says what they know and how well (``mereo release``).

The card follows Mitchell et al., "Model cards for model reporting" (FAT* 2019), as far as it can be written from what
the weights and their tests say themselves.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch

from mereo.geometry.metrics import format_score
from mereo.io.atomic_files import new_directory
from mereo.models.calibration import calibration_rows
from mereo.models.model import Model
from mereo.models.weights import load_model, save_model, weights_bytes
from mereo.scenes.statistical_model import modes_within, with_fewer_modes
from mereo.synthesis.config import SENSORS, GenerateConfig, SensorConfig
from mereo_learning.run_directory import describe_seen
from mereo_learning.tables import read_metrics

MOST_BYTES = 8_000_000
"""Size of a released file at most; modes that do not fit are left out."""

HEADER_BYTES = 4_000
"""Bytes that names and shapes of the statistical model take."""

PLAIN_CHARACTERS = "abcdefghijklmnopqrstuvwxyz0123456789-_"

ANSWERS = {"network": "the network alone", "modes": "registered modes", "full": "with the draws of the scene"}
"""Who could have answered a test, and the words for it."""


def release(
    weights: str | Path, name: str, output: str | Path, tests: Sequence[Path] = (), force: bool = False
) -> Path:
    """Write ``NAME.safetensors`` (float16) and ``NAME.md`` into a new folder; returns the weights' path.

    Args:
        weights: a shipped name or a file.
        name: lower case letters, digits, - and _.
        output: folder to create.
        tests: folders that `mereo evaluate` has written, of these weights.
        force: replace an existing folder that mereo wrote.

    Raises ``ValueError`` for odd names, and for tests of other segments; ``FileNotFoundError`` for folders without
    metrics.json.
    """
    if not name or set(name) - set(PLAIN_CHARACTERS):
        raise ValueError(
            f"the name is {name!r}; weights are named by lower case letters, digits, - and _: choose others"
        )
    with new_directory(output, force, [weights, *tests]) as directory:
        model = _with_statistical_model(_without_places(load_model(weights)))
        scores = [_metrics(folder, model) for folder in tests]
        path = directory / f"{name}.safetensors"
        save_model(model, path, torch.float16)
        (directory / f"{name}.md").write_text(card(name, model, scores, path.read_bytes()), encoding="utf-8")
    print(f"wrote {Path(output) / path.name} and its card {name}.md")
    return Path(output) / path.name


CARD = """\
# {name}

`{name}.safetensors`, {megabytes:.1f} MB, SHA-256 `{digest}`.

{object}

## Training

{training}

## Calibration

{calibration}

## Results

IoU takes all segments as one, mIoU is the mean over segments; 100^3 cells of the joint box, one confusion
matrix over the set.

{results}

## Limits

{limits}
"""


def card(name: str, model: Model, tests: Sequence[dict[str, Any]], content: bytes) -> str:
    """Model card as Markdown; ``content`` is the weights' file."""
    return CARD.format(
        name=name,
        megabytes=len(content) / 2**20,
        digest=sha256(content).hexdigest(),
        object=_lines(_object(model)),
        training=_lines(_training(model.provenance)),
        calibration=_lines(dict(calibration_rows(model.calibration))),
        results="\n\n".join(map(_result, tests)) or "Not measured yet: `mereo evaluate`.",
        limits="\n".join(f"- {limit}" for limit in _limits(tests)),
    )


def _lines(facts: Mapping[str, Any]) -> str:
    return "\n".join(f"- {title}: {value}" for title, value in facts.items() if value)


def _object(model: Model) -> dict[str, Any]:
    made, states, taught = model.provenance, model.statistical_model, model.supervision
    sizes: Any = made.get("visible_m")
    answers = {"labels": taught.labels, "signed distances": taught.distances, "directions": taught.directions}
    return {
        "scene": f"`{made.get('scene', 'unknown')}`",
        "segments": ", ".join(model.names),
        "model": made.get("source"),
        "nested": ", ".join(f"{inner} in {outer}" for inner, outer in model.nested),
        "longest side of the visible part in training": sizes and f"{sizes[0]:.3g} to {sizes[1]:.3g} m",
        "registration": "none: the network answers alone"
        if states is None
        else f"the mesh at rest and {states.count} modes of deformation, which leave {states.residue:.2g} scene units "
        "(root mean square) of an unseen state",
        "answers": ", ".join(answer for answer, is_taught in answers.items() if is_taught),
    }


def _training(made: Mapping[str, Any]) -> dict[str, Any]:
    recipe, data = made.get("recipe") or {}, made.get("data")
    seen = describe_seen(made)
    return {
        "data": f"{made.get('training_examples', 'unknown')} examples of seed {made.get('training_seed')}",
        "generated by": f"mereo {made.get('mereo', 'unknown')}",
        "how they were generated": data and f"`{json.dumps(data)}`",
        "steps": f"{made.get('steps')} steps of {recipe.get('batch')} examples" + f", {seen}" * bool(seen),
        "recipe": recipe and f"`{json.dumps(recipe)}`",
    }


def _result(test: Mapping[str, Any]) -> str:
    """Table of a test's scores under its title, and a line on who else could have answered."""
    if "scans" in test:
        title = f"{len(test['scans'])} real scans ({', '.join(test['scans'])})"
    else:
        title = f"{test['examples']} synthetic views, test seed {test['seed']}, {_camera(test)}"
    scores = {"IoU": test["iou"], "mIoU": test["miou"], **test["per_segment"]}
    rows = [" | ".join(scores), "---|" * len(scores), " | ".join(map(format_score, scores.values()))]
    each = [
        f"{name} {format_score(test[key]['iou'])} / {format_score(test[key]['miou'])} in {test[key]['seconds']:.2f} s"
        for key, name in ANSWERS.items()
        if test.get(key) is not None
    ]
    others = f"\n\nBy who answers (IoU / mIoU, seconds of a frame): {', '.join(each)}." if len(each) > 1 else ""
    return f"{title}:\n\n| {rows[0]} |\n|{rows[1]}\n| {rows[2]} |{others}"


def _camera(test: Mapping[str, Any]) -> str:
    """Words for the camera of synthetic views: what differs from the paper's, and the noise."""
    sensor, size = SensorConfig(**(test.get("sensor") or {})), test.get("image_size", GenerateConfig.image_size)
    named = [name.replace("-", " ") for name, known in SENSORS.items() if known == replace(sensor, tool=known.tool)]
    words = {
        named[0] if named else "a camera of its own terms": sensor.on,
        f"a tool in {sensor.tool:.0%} of them": sensor.tool,
        f"{size} x {size} pixels": size != GenerateConfig.image_size,
        f"workspace {test.get('workspace')}": test.get("workspace", "own") != "own",
        f"noise {test.get('noise_std', 0.1)} units": True,
    }
    return ", ".join(word for word, is_special in words.items() if is_special)


def _limits(tests: Sequence[dict[str, Any]]) -> list[str]:
    limits = [
        "Knows this object in its scene's states, alone in the cloud, seen from where the scene puts the camera.",
        "Hidden parts are the likeliest of those states, not measurements.",
    ]
    for test in tests:
        known = {name: value for name, value in test["per_segment"].items() if value is not None}
        if known:
            worst = min(known, key=lambda segment: known[segment])
            of = "on scans" if "scans" in test else "on synthetic views"
            limits.append(f"Weakest segment {of}: {worst}, IoU {known[worst]:.3f}.")
    return limits if any("scans" in test for test in tests) else [*limits, "Not tested on a real sensor."]


def _metrics(folder: Path, model: Model) -> dict[str, Any]:
    path = folder / "metrics.json"
    if not path.is_file():
        raise FileNotFoundError(f"{folder} has no metrics.json; --tests takes folders that mereo evaluate has written")
    metrics = read_metrics(path)
    if tuple(metrics["per_segment"]) != model.names:
        raise ValueError(
            f"{folder} is a test of {', '.join(metrics['per_segment'])}, but the weights know "
            f"{', '.join(model.names)}; give tests of these weights"
        )
    return metrics


def _with_statistical_model(model: Model) -> Model:
    """The weights with as many modes of the object's states as fit into ``MOST_BYTES`` next to the network."""
    states = model.statistical_model
    if states is None:
        return model
    left = MOST_BYTES - HEADER_BYTES - len(weights_bytes(replace(model, statistical_model=None), torch.float16))
    return replace(model, statistical_model=with_fewer_modes(states, modes_within(states, left)))


def _without_places(model: Model) -> Model:
    """Folders of the machine that trained are nobody's business: of ``init`` the file's name stays."""
    recipe: Any = model.provenance.get("recipe")
    if not recipe or not recipe.get("init"):
        return model
    return replace(model, provenance={**model.provenance, "recipe": recipe | {"init": Path(recipe["init"]).name}})
