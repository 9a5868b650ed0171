"""What options of several commands share: their kinds, the object that they name, and what a command leaves behind.

Positional arguments have one word for one thing in all commands, as usage lines and help show it:

SCENE    a name from `mereo scene list`, or a scene file
OBJECT   what an object is made from: its meshes, or a label volume
DATASET  folder of `mereo generate`, or its URL
WEIGHTS  a shipped name, or a file
INPUT    what a sensor has seen: depth image, cloud, recording, or a folder of such
SCAN     a cloud that truth is made for
ASSET    a name from `mereo assets list`
REPOSITORY   weights on a model hub
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg
from tyro.constructors import PrimitiveConstructorSpec

from mereo.io.object_storage import Place, place_of
from mereo.models.config import InferenceConfig

if TYPE_CHECKING:
    from mereo.api.objects import Object

NOT_RECOGNIZED = 3
"""Exit status of a command whose answer is not recognized as the object."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a command that answers.

    Attributes:
        facts: content of the JSON object that ``--json`` prints.
        status: exit status.
    """

    facts: Mapping[str, Any]
    status: int = 0


# --- kinds of options -------------------------------------------------------------------------------------------------


class _InOptionsFile:
    """How pydantic reads what a file of options has for a ``PlaceOption``."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema

        return core_schema.no_info_after_validator_function(place_of, core_schema.str_schema())


PlaceOption = Annotated[
    Place,
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=lambda words: place_of(words[0]),
        is_instance=lambda value: isinstance(value, Place),
        str_from_instance=lambda place: [str(place)],
    ),
    _InOptionsFile(),
]
"""Local path or URL of an object storage, of which ``Path`` would make s3:/bucket."""

SceneName = Annotated[Positional[str], arg(metavar="SCENE")]
SceneNameOrNone = Annotated[Positional[str], arg(metavar="[SCENE]", help_behavior_hint="")]
ObjectFiles = Annotated[
    Positional[tuple[Path, ...]], arg(metavar="OBJECT [OBJECT ...]", help_behavior_hint="(required)")
]
DatasetFolder = Annotated[Positional[PlaceOption], arg(metavar="DATASET")]
WeightsName = Annotated[Positional[str], arg(metavar="WEIGHTS")]
WeightsFiles = Annotated[Positional[tuple[Path, ...]], arg(metavar="[WEIGHTS ...]", help_behavior_hint="")]
Inputs = Annotated[Positional[tuple[Path, ...]], arg(metavar="INPUT [INPUT ...]", help_behavior_hint="(required)")]
InputOrNone = Annotated[Positional[Path | None], arg(metavar="[INPUT]", help_behavior_hint="")]
InputName = Annotated[Positional[str], arg(metavar="INPUT")]
ScanCloud = Annotated[Positional[Path], arg(metavar="SCAN")]
AssetNames = Annotated[Positional[tuple[str, ...]], arg(metavar="[ASSET ...]", help_behavior_hint="")]
RepositoryName = Annotated[Positional[str], arg(metavar="REPOSITORY")]

METAVARS = ("SCENE", "OBJECT", "DATASET", "WEIGHTS", "INPUT", "SCAN", "ASSET", "REPOSITORY")
"""The words; an experiment is chosen from a list, which is shown in the place of one."""

MeshUnits = Literal["mm", "cm", "m", "in"] | None
"""Unit of meshes; None guesses."""


# --- the object that options name -------------------------------------------------------------------------------------


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
