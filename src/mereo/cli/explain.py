"""``mereo reconstruct --explain``: what decides where a point of the object, or a segment's centroid, is."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mereo.fitting.registration.registration import Registration
from mereo.geometry.radii import level_told
from mereo.io.writers.meshes import write_explained_ply
from mereo.visualization.reconstruction_report import UNEXPLAINED, describe_shares, mark_colors, point_marks
from mereo.visualization.units import Unit, rounded

FOLDER = "explained"
"""Folder within a folder of results that holds the observed points of each explanation."""

Wish = str | Float[np.ndarray, "3"]
"""What is to be explained: the name of a segment, or a place."""


def wish_of(text: str, names: Sequence[str]) -> Wish:
    """Wish of an option's text; raises ``ValueError`` for what is neither a segment nor a place."""
    if text in names:
        return text
    try:
        place = np.array([float(part) for part in text.split(",")])
    except ValueError:
        place = np.empty(0)
    if len(place) != 3 or not np.isfinite(place).all():
        raise ValueError(
            f"--explain is {text!r}; it must be a segment ({', '.join(names)}) or a place x,y,z in the input's frame "
            "and unit, such as --explain=0.1,-0.02,0.8"
        )
    return place


def print_sure(registered: Registration | None, unit: Unit) -> None:
    """Print how far off the surface of a registered model may be; nothing for the network's answer."""
    if registered is None or registered.uncertainty is None:
        return
    told = registered.uncertainty.summary()
    middle, most = (f"{rounded(told[key] * unit.length_factor)} {unit.length_name}" for key in ("median", "max"))
    level = level_told(registered.uncertainty.calibrated)
    print(f"its points are within {middle} of their true places in the median, {most} where it is least sure ({level})")


def explain(
    registered: Registration | None,
    wishes: Sequence[Wish],
    directory: Path,
    points: Float[np.ndarray, "n 3"],
    factor: float,
    unit: Unit,
) -> None:
    """Print a line for each wish, and write the observed points coloured by how much they decide it.

    Args:
        registered: in the input's frame; None raises ``ValueError`` where there are wishes.
        wishes: what is to be explained.
        directory: of the results.
        points: observed ones, in the input's frame and unit.
        factor: from the input's unit to that of the file.
        unit: of the lengths that are printed.
    """
    for number, wish in enumerate(wishes, 1):
        if registered is None or registered.uncertainty is None:
            raise ValueError(
                "the network's answer is kept, but --explain needs a registration, whose fit is explained: leave out "
                "of the cloud what is not the object, or take the registered model in any case with --method modes"
            )
        found, radius = registered.explain(wish), _radius(registered, wish)
        assert found is not None
        named = f"the centre of {wish}" if isinstance(wish, str) else "the object's point"
        level = level_told(registered.uncertainty.calibrated)
        said = f"{named} is at {unit.place(found.place, radius)} {unit.length_name}"
        told = f"{said} ({level}); what leaves it unsure: {describe_shares(found)}"
        lost = len(found.unexplained)
        print(f"{told}; {lost} points are not the model's" if lost else told)
        marks = point_marks(found, points)
        (directory / FOLDER).mkdir(exist_ok=True)
        write_explained_ply(
            directory / FOLDER / f"{number}.ply", factor * points, mark_colors(marks), marks == UNEXPLAINED, told
        )


def _radius(registered: Registration, wish: Wish) -> float:
    """Radius of 95 % of what is explained, input unit."""
    sure = registered.uncertainty
    assert sure is not None
    if isinstance(wish, str):
        return sure.segments[registered.model.rest.names.index(wish)].centroid_radius95
    found = registered.radius95(wish[None], at="camera")
    assert found is not None
    return float(found[0])
