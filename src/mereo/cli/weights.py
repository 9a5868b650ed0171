"""``mereo weights list`` and ``mereo weights show``: what files of weights and their model cards say."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from mereo.io.atomic_files import to_json
from mereo.models.calibration import calibration_rows
from mereo.models.weights_facts import WeightsFacts, read_facts
from mereo.models.weights_place import SHIPPED, shipped_names
from mereo.training.examples_seen import seen_in_all, told
from mereo.training.model_card import CardResult, card_results, nearest_preset

LIST_COLUMNS = ("name", "object", "segments", "parameters", "size", "IoU mIoU", "of scans")

ENCODERS = {"pointnet2": "PointNet++", "point-transformer": "Point Transformer", "autodecoder": "autodecoder"}


def list_weights(places: Sequence[Path]) -> None:
    """Print a row for each file of weights: the shipped ones, or these files and those in these folders.

    Raises ``FileNotFoundError`` and ``ValueError`` as ``read_facts`` does, and for a folder without weights.
    """
    files: list[str | Path] = [*shipped_names()] if not places else [file for place in places for file in _in(place)]
    table = Table(title=f"weights in {SHIPPED}" if not places else None, title_justify="left")
    for number, column in enumerate(LIST_COLUMNS):
        text = number < 2
        table.add_column(column, justify="left" if text else "right", overflow="fold", no_wrap=not text)
    for file in files:
        facts = read_facts(file)
        views, scans = _scores(_card(facts.path), False), _scores(_card(facts.path), True)
        name = facts.path.stem if not places else str(file)
        known = str(len(facts.header.names))
        table.add_row(name, facts.scene, known, f"{facts.parameters / 1e6:.2f} M", _size(facts.bytes), views, scans)
    console = Console(markup=False, emoji=False)
    console.print(table)
    console.print(
        "IoU takes all segments as one, mIoU is their mean, over unseen synthetic views, or real scans, as the card "
        "says. More of one: mereo weights show NAME",
        highlight=False,
        soft_wrap=True,
    )


def _in(place: Path) -> list[Path]:
    """Files of weights that a place is or holds; a checkpoint of a training is none."""
    if not place.is_dir():
        return [place]
    found = sorted(file for file in place.rglob("*.safetensors") if _is_weights(file))
    if not found:
        raise ValueError(f"{place} holds no weights; name a .safetensors file of mereo train, or a folder of such")
    return found


def _is_weights(file: Path) -> bool:
    try:
        read_facts(file)
    except ValueError:
        return False
    return True


def _card(path: Path) -> list[CardResult]:
    """Results of the card that lies beside a file of weights; none without one."""
    card = path.with_suffix(".md")
    return card_results(card.read_text("utf-8")) if card.is_file() else []


def _scores(results: Sequence[CardResult], scans: bool) -> str:
    found = next((result for result in results if result.on_scans == scans), None)
    return "" if found is None else f"{found.scores.get('IoU', '-')} {found.scores.get('mIoU', '-')}"


def _size(count: int) -> str:
    return f"{count / 2**20:.1f} MB"


def show_weights(name: str, as_json: bool = False) -> None:
    """Print what weights know and where they come from; raises as ``read_facts`` does."""
    facts = read_facts(name)
    if as_json:
        print(json.dumps(to_json(_everything(facts)), indent=2))
        return
    for title, value in _rows(facts):
        print(f"{title:<14} {value}")
    _print_results(facts)


def _everything(facts: WeightsFacts) -> dict[str, Any]:
    """All that is known, for programs."""
    states = facts.states
    return {
        "path": facts.path.absolute(),
        "bytes": facts.bytes,
        "sha256": facts.sha256,
        "format": facts.version,
        "stored_as": facts.stored_as,
        "scene": facts.scene,
        "segments": [
            {"label": number + 1, "name": name, "color": color}
            for number, (name, color) in enumerate(zip(facts.header.names, facts.header.colors, strict=True))
        ],
        "nested": facts.header.nested,
        "unit_m": facts.unit_m,
        "loss": facts.header.loss,
        "parameters": facts.parameters,
        "network": facts.network.to_dict(),
        "statistical_model": None if states is None else vars(states),
        "calibration": facts.header.calibration and facts.header.calibration.model_dump(exclude_none=True),
        "examples_seen": seen_in_all(facts.header.provenance),
        "provenance": facts.header.provenance,
        "results": [{"title": result.title, **result.scores} for result in _card(facts.path)],
    }


def _rows(facts: WeightsFacts) -> list[tuple[str, str]]:
    """Facts in words, each with its title."""
    header, network, made = facts.header, facts.network, facts.header.provenance
    rows = [
        ("weights", f"{facts.path}, {_size(facts.bytes)}, {facts.stored_as}, format {facts.version}"),
        ("SHA-256", facts.sha256),
        ("object", facts.scene + (f": {made['source']}" if made.get("source") else "")),
        ("segments", ", ".join(f"{number + 1} {name}" for number, name in enumerate(header.names))),
    ]
    if header.nested:
        rows.append(("nested", ", ".join(f"{inner} in {outer}" for inner, outer in header.nested)))
    rows.append(("unit", _unit(facts)))
    taught = facts.supervision
    kinds = {"labels": taught.labels, "signed distances": taught.distances, "directions": taught.directions}
    rows += [
        ("answers", ", ".join(kind for kind, known in kinds.items() if known)),
        ("network", f"{ENCODERS[network.encoder]}, {facts.parameters:,} parameters, sees {network.points} points"),
        ("registration", _registration(facts)),
        *calibration_rows(facts.header.calibration),
        ("training", _training(made)),
    ]
    return rows


def _unit(facts: WeightsFacts) -> str:
    seen = facts.header.provenance.get("visible_m")
    size = f"visible part {seen[0]:.3g} to {seen[1]:.3g} m long in training" if seen else "size in training not known"
    known = "true size not known" if facts.unit_m is None else f"{1000 * facts.unit_m:.4g} mm to a scene unit"
    return f"{known}; {size}"


def _registration(facts: WeightsFacts) -> str:
    if facts.states is None:
        return "none: the network answers alone"
    states = facts.states
    return (
        f"mesh at rest ({states.vertices:,} vertices) and {states.modes} modes of {states.states:,} states, which "
        f"leave {states.residue:.2g} scene units of an unseen state"
    )


def _training(made: dict[str, Any]) -> str:
    recipe = made.get("recipe") or {}
    parts = [
        f"{made['steps']:,} steps" if made.get("steps") else "",
        f"of {recipe['batch']} examples" if recipe.get("batch") else "",
        f"on {made['training_examples']:,} of seed {made.get('training_seed')}"
        if made.get("training_examples")
        else "",
        told(made),
        f"preset {nearest_preset(recipe)}" if recipe.get("network") else "",
        f"started from {recipe['init']}" if recipe.get("init") else "",
        f"mereo {made['mereo']}" if made.get("mereo") else "",
    ]
    return ", ".join(part for part in parts if part).replace(", of", " of") or "not known"


def _print_results(facts: WeightsFacts) -> None:
    """Scores and limits, as the card says them."""
    card = facts.path.with_suffix(".md")
    console = Console(markup=False, emoji=False)
    if not card.is_file():
        print(f"no model card beside it; to measure and write one:\n  mereo evaluate {facts.path} --output test")
        print(f"  mereo release {facts.path} --name {facts.path.stem} --tests test --output released")
        return
    text = card.read_text("utf-8")
    for result in card_results(text):
        table = Table()
        table.add_column("")
        table.add_column("IoU", justify="right")
        for name, score in result.scores.items():
            shown = {"IoU": "all as one (IoU)", "mIoU": "mean of segments (mIoU)"}.get(name, name)
            table.add_row(shown, score)
        print(f"\n{result.title}")
        console.print(table)
        if result.answers:
            console.print(result.answers, highlight=False, soft_wrap=True)
    limits = text.partition("## Limits\n")[2].strip()
    if limits:
        print(f"\n{limits}")
    print(f"\ncard           {card}")
