"""The option ``--object`` of the commands that find one: what is looked for, with weights or without."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from mereo.models.config import InferenceConfig

if TYPE_CHECKING:
    from mereo.api.objects import Object

MeshUnits = Literal["mm", "cm", "m", "in"] | None
"""Unit of meshes; None guesses."""


def check_named(command: str, object: Sequence[str], weights: str | Path | None) -> None:
    """Raise ``ValueError`` where neither an object nor weights are named."""
    if not object and weights is None:
        raise ValueError(
            f"no object is named; name its meshes or its scene with --object, or its weights with --weights: mereo "
            f"{command} FRAME --object PART.stl PART.stl"
        )


def loaded_object(
    object: Sequence[str],
    weights: str | Path | None,
    scene: str | None = None,
    units: MeshUnits = None,
    inference: InferenceConfig = InferenceConfig(),  # noqa: B008 (frozen)
) -> "Object":
    """Object that options name: ``--object``, ``--weights`` and ``--scene``; raises as ``load_object`` does.

    One word of ``--object`` that is a built-in scene's name is that scene; its weights are named by ``--weights``.
    """
    from mereo.api.objects import load_object
    from mereo.scenes.registry import load_scene
    from mereo.scenes.scene import SCENES

    if object and scene is not None:
        raise ValueError(f"--scene is {scene}, but --object says what the object is: leave one of them out")
    one = object[0] if len(object) == 1 else None
    source = list(object) or None if one is None else load_scene(one) if one in SCENES else one
    return load_object(
        source, scene, weights=weights, units=units, device=inference.device, precision=inference.precision
    )


def files_read(object: Sequence[str], weights: str | Path | None) -> list[str | Path]:
    """Files that are read for these options, so that no output takes their place."""
    return [*(one for one in object if Path(one).exists()), *([] if weights is None else [weights])]
