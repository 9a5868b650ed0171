"""Released weights, at half the size, with a card that says what they know and how well (``mereo release``).

The card follows Mitchell et al., "Model cards for model reporting" (FAT* 2019), as far as it can be written from what
the weights and their tests say themselves.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch

from mereo.evaluation.metrics import format_score
from mereo.evaluation.tables import read_metrics
from mereo.io.output_folders import new_directory
from mereo.models.calibration import calibration_rows
from mereo.models.config import NetworkConfig
from mereo.models.model import Model
from mereo.models.weights import load_model, save_model, weights_bytes
from mereo.scenes.statistical_model import modes_within, with_fewer_modes
from mereo.synthesis.config import SENSORS, GenerateConfig, SensorConfig
from mereo.training.config import PRESETS
from mereo.training.examples_seen import told

MOST_BYTES = 8_000_000
"""Size of a released file at most; modes that do not fit are left out."""

HEADER_BYTES = 4_000
"""Bytes that names and shapes of the statistical model take."""

PLAIN_CHARACTERS = "abcdefghijklmnopqrstuvwxyz0123456789-_"


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
        found = [_metrics(folder, model) for folder in tests]
        path = directory / f"{name}.safetensors"
        save_model(model, path, torch.float16)
        (directory / f"{name}.md").write_text(card(name, model, found, path.read_bytes()), encoding="utf-8")
    print(f"wrote {Path(output) / path.name} and its card {name}.md")
    return Path(output) / path.name


def card(name: str, model: Model, tests: Sequence[dict[str, Any]], content: bytes) -> str:
    """Model card as Markdown; ``content`` is the weights' file."""
    size, digest = f"{len(content) / 2**20:.1f} MB", sha256(content).hexdigest()
    parts = [
        f"# {name}\n",
        f"`{name}.safetensors`, {size}, float16, SHA-256 `{digest}`. Written by `mereo release`.\n",
        _object(model),
        _training(model.provenance),
        _calibration(model),
        "## Results\n",
        "IoU takes all segments as one, mIoU is the mean over segments; 100^3 cells of the joint box, one confusion\n"
        "matrix over the set.\n",
        *([_result(test) for test in tests] or ["Not measured yet: `mereo evaluate`.\n"]),
        _limits(model, tests),
    ]
    return "\n".join(parts)


def _object(model: Model) -> str:
    provenance = model.provenance
    lines = [f"- scene: `{provenance.get('scene', 'unknown')}`", f"- segments: {', '.join(model.names)}"]
    if provenance.get("source"):
        lines.append(f"- model: {provenance['source']}")
    if model.nested:
        lines.append(f"- nested: {', '.join(f'{inner} in {outer}' for inner, outer in model.nested)}")
    sizes = provenance.get("visible_m")
    if isinstance(sizes, list | tuple):
        lines.append(f"- longest side of the visible part in training: {sizes[0]:.3g} to {sizes[1]:.3g} m")
    states = model.statistical_model
    if states is not None:
        lines.append(
            f"- registration: the mesh at rest and {states.count} modes of deformation, which leave "
            f"{states.residue:.2g} scene units (root mean square) of an unseen state"
        )
    taught = model.supervision
    answers = {"labels": taught.labels, "signed distances": taught.distances, "directions": taught.directions}
    known = [answer for answer, is_taught in answers.items() if is_taught]
    return "\n".join([*lines, f"- answers: {', '.join(known)}", ""])


def _training(provenance: dict[str, object]) -> str:
    recipe: Any = provenance.get("recipe") or {}
    batch, steps = recipe.get("batch"), provenance.get("steps")
    seen = told(provenance)
    lines = [
        "## Training\n",
        f"- data: {provenance.get('training_examples', 'unknown')} examples of seed {provenance.get('training_seed')}, "
        f"generated by mereo {provenance.get('mereo', 'unknown')}",
    ]
    if provenance.get("data"):
        lines.append(f"- how they were generated: `{json.dumps(provenance['data'])}`")
    lines += _observations(provenance)
    lines.append(f"- {steps} steps of {batch} examples" + f", {seen}" * bool(seen))
    if recipe:
        lines.append(f"- recipe, nearest preset `{nearest_preset(recipe)}`: `{json.dumps(recipe)}`")
    return "\n".join([*lines, ""])


def _calibration(model: Model) -> str:
    rows = (f"- {title}: {text}" for title, text in calibration_rows(model.calibration))
    return "\n".join(["## Calibration\n", *rows, ""])


def _observations(provenance: dict[str, Any]) -> list[str]:
    """Line on the further observations that were trained on; none where there were none."""
    names = (provenance.get("data") or {}).get("observations")
    share = (provenance.get("recipe") or {}).get("augment", {}).get("observations")
    if not names or not share:
        return []
    return [
        f"- observations: in {100 * share:g} % of its turns an example is seen by one of {', '.join(names)} instead"
    ]


def nearest_preset(recipe: dict[str, Any]) -> str:
    """Name of the preset whose network it is, else of which most settings are."""
    network = NetworkConfig.from_dict(recipe["network"])  # what older recipes do not state is at its default
    share = recipe.get("augment", {}).get("observations", 0.0)  # which the dataset decides, too

    def agreement(preset: str) -> tuple[bool, int]:
        compared = replace(PRESETS[preset], augment=replace(PRESETS[preset].augment, observations=share))
        known = json.loads(json.dumps(compared.to_dict()))
        return PRESETS[preset].network == network, sum(known[key] == recipe.get(key) for key in known)

    return max(PRESETS, key=agreement)


SEEN_FROM = {"cone": "cameras on one side of the object", "sphere": "cameras all around the object"}
"""Words for workspaces other than the scene's own."""


def _camera(test: dict[str, Any]) -> str:
    """Words for a camera that is not the paper's, with a comma behind; nothing for the paper's."""
    sensor, size = SensorConfig(**(test.get("sensor") or {})), test.get("image_size", GenerateConfig.image_size)
    named = [name.replace("-", " ") for name, known in SENSORS.items() if known == replace(sensor, tool=known.tool)]
    words = [named[0] if named else "a camera of its own terms"] if sensor.on else []
    words += [f"a tool in {sensor.tool:.0%} of them"] if sensor.tool else []
    words += [f"{size} x {size} pixels"] if size != GenerateConfig.image_size else []
    words += [SEEN_FROM[test["workspace"]]] if test.get("workspace", "own") != "own" else []
    return "".join(f"{word}, " for word in words)


def _result(test: dict[str, Any]) -> str:
    segments = test["per_segment"]
    if "scans" in test:
        title = f"{len(test['scans'])} real scans ({', '.join(test['scans'])})"
    else:
        noise = f"noise {test.get('noise_std', 0.1)} units"
        title = f"{test['examples']} synthetic views, test seed {test['seed']}, {_camera(test)}{noise}"
    names = ["IoU", "mIoU", *segments]
    values = [test["iou"], test["miou"], *segments.values()]
    rows = [f"| {' | '.join(names)} |", f"|{'---|' * len(names)}", f"| {' | '.join(format_score(v) for v in values)} |"]
    return "\n".join([f"{title}:\n", *rows, "", *_answers(test)])


@dataclass(frozen=True)
class CardResult:
    """One test of a card, as text.

    Attributes:
        title: what was tested.
        scores: as the card rounds them: "IoU", "mIoU", then each segment.
        answers: line on who could have answered; empty where only the network could.
    """

    title: str
    scores: dict[str, str]
    answers: str

    @property
    def on_scans(self) -> bool:
        """Whether the test was of real scans."""
        return "real scans" in self.title


def card_results(text: str) -> list[CardResult]:
    """Tests that a card tells of, the inverse of what ``card`` writes; none where it was written otherwise."""
    lines = [line.strip() for line in text.partition("## Results\n")[2].partition("## ")[0].splitlines()]
    found = []
    for number, line in enumerate(lines):
        if line.startswith("| IoU |") and number + 2 < len(lines):
            names, values = ([cell.strip() for cell in lines[n].strip("|").split("|")] for n in (number, number + 2))
            title = next((before for before in reversed(lines[:number]) if before), "").removesuffix(":")
            after = next((later for later in lines[number + 3 :] if later), "")
            found.append(CardResult(title, dict(zip(names, values, strict=False)), after * after.startswith("By who")))
    return found


def _answers(test: dict[str, Any]) -> list[str]:
    """Scores of all who could have answered, one line; nothing where the network alone could."""
    titles = {"network": "the network alone", "modes": "registered modes", "full": "with the draws of the scene"}
    each = []
    for name, title in titles.items():
        if test.get(name) is not None:
            iou, miou = (format_score(test[name][key]) for key in ("iou", "miou"))
            each.append(f"{title} {iou} / {miou} in {test[name]['seconds']:.2f} s")
    return [f"By who answers (IoU / mIoU, seconds of a frame): {', '.join(each)}.", ""] if len(each) > 1 else []


def _limits(model: Model, tests: Sequence[dict[str, Any]]) -> str:
    lines = [
        "## Limits\n",
        "- Knows this object in its scene's states, alone in the cloud, seen from where the scene puts the camera.",
        "- Hidden parts are the likeliest of those states, not measurements.",
    ]
    for test in tests:
        known = {name: value for name, value in test["per_segment"].items() if value is not None}
        if known:
            worst = min(known, key=lambda segment: known[segment])
            of = "on scans" if "scans" in test else "on synthetic views"
            lines.append(f"- Weakest segment {of}: {worst}, IoU {known[worst]:.3f}.")
    if not any("scans" in test for test in tests):
        lines.append("- Not tested on a real sensor.")
    return "\n".join([*lines, ""])


def _metrics(folder: Path, model: Model) -> dict[str, Any]:
    path = folder / "metrics.json"
    if not path.is_file():
        raise FileNotFoundError(f"{folder} has no metrics.json; --tests takes folders that mereo evaluate has written")
    found = read_metrics(path)
    if tuple(found["per_segment"]) != model.names:
        raise ValueError(
            f"{folder} is a test of {', '.join(found['per_segment'])}, but the weights know {', '.join(model.names)}; "
            "give tests of these weights"
        )
    return found


def _with_statistical_model(model: Model) -> Model:
    """The weights with as many modes of the object's states as fit into ``MOST_BYTES`` beside the network."""
    found = model.statistical_model
    if found is None:
        return model
    left = MOST_BYTES - HEADER_BYTES - len(weights_bytes(replace(model, statistical_model=None), torch.float16))
    return replace(model, statistical_model=with_fewer_modes(found, modes_within(found, left)))


def _without_places(model: Model) -> Model:
    """Folders of the machine that trained are nobody's business: of ``init`` the file's name stays."""
    recipe: Any = model.provenance.get("recipe")
    if not recipe or not recipe.get("init"):
        return model
    kept = {**recipe, "init": Path(recipe["init"]).name}
    return replace(model, provenance={**model.provenance, "recipe": kept})
