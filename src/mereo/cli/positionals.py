"""Positional arguments of all commands: one word for one thing, as usage lines and help show it.

SCENE    a name from `mereo scene list`, or a scene file
OBJECT   what an object is made from: its meshes, or a label volume
DATASET  folder of `mereo generate`, or its URL
WEIGHTS  a shipped name, or a file
INPUT    what a sensor has seen: depth image, cloud, recording, or a folder of such
SCAN     a cloud that truth is made for
ASSET    a name from `mereo assets list`
REPOSITORY   weights on a model hub
"""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mereo.cli.place_option import PlaceOption

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
