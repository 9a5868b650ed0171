"""Parameters of a request: the options of ``mereo reconstruct`` by the same names, checked before anything is read."""

import re
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, Json
from pydantic_core import ErrorDetails

from mereo.geometry.conventions import CloudAxes
from mereo.io.config import DepthAlong, InputConfig, Viewpoint
from mereo.reconstruction.config import Extent, IsolationConfig
from mereo_serving.messages import Refused

Config = TypeVar("Config", InputConfig, IsolationConfig)


def _numbers(count: int) -> BeforeValidator:
    """So many numbers of ``0.4,0.9`` or ``0.4 0.9``, or of the parameter that is given again for each."""

    def split(given: Any) -> list[str]:
        words = " ".join(given if isinstance(given, list) else [given]).replace(",", " ").split()
        if len(words) != count:
            raise ValueError(f"{count} numbers")
        return words

    return BeforeValidator(split)


Numbers = tuple[float, ...] | None


class FrameOptions(BaseModel):
    """Parameters of a frame, in the query of its address."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, alias_generator=lambda name: name.replace("_", "-"))

    format: str | None = Field(None, description="Suffix of the frame's format, where its Content-Type does not say it")
    intrinsics: str | None = Field(None, description="The depth camera as JSON; or send it as a part of that name")
    depth_scale: float | None = Field(None, description="Pixel value of one metre")
    depth_along: DepthAlong = Field("z", description="What a depth image measures: z, ray")
    mask_value: list[int] = Field([], description="The object's values in a mask of ids")
    viewpoint: Viewpoint = Field("auto", description="Use of a PCD file's pose: auto, pose, ignored")
    frame: CloudAxes = Field("camera", description="Axes of a point cloud")
    drop_invalid: bool = Field(False, description="Leave out points without a measurement")
    unit_m: float | None = Field(None, description="Metres per unit of a point cloud")
    frame_index: int | None = Field(None, description="Frame of intrinsics that describe many")
    depth_range: Annotated[Numbers, _numbers(2)] = Field(None, description="Nearest and farthest depth kept, m")
    box: Annotated[Numbers, _numbers(6)] = Field(
        None, description="Corners of what is kept: x0,y0,z0,x1,y1,z1 in metres"
    )
    remove_plane: bool = Field(False, description="Leave out the largest plane")
    remove_outliers: bool = Field(False, description="Leave out lone points")
    largest_cluster: bool = Field(False, description="Keep the largest group of points")
    cluster_gap: float = Field(0.0, description="Gap across which groups belong to it, metres")
    keep_all: bool = Field(False, description="Drop no strays")
    point: Annotated[Numbers, _numbers(2)] = Field(
        None, description="Column and row of a pixel of the object, in a depth image: u,v"
    )
    extent: Extent = Field("auto", description="How much of the object the frame shows: whole, partial, surface, auto")
    joints: Json[dict[str, Any]] | None = Field(None, description='Known values of joints as JSON: {"hinge": 1.51}')
    resolution: int | None = Field(None, description="Cells along the longest side; by default the server's")

    def reading(self, folder: Path, intrinsics: str | None, mask: str | None) -> InputConfig:
        """How the frame is read, with the files of these names in a folder; raises ``Refused`` (422)."""
        files = {"intrinsics": intrinsics, "mask": mask}
        paths = {name: None if file is None else folder / file for name, file in files.items()}
        return self._config(InputConfig, {**paths, "mask_value": tuple(self.mask_value)})

    def isolation(self) -> IsolationConfig:
        """What of the frame is left out; raises ``Refused`` (422)."""
        return self._config(IsolationConfig, {})

    def _config(self, kind: type[Config], changed: dict[str, Any]) -> Config:
        """Settings whose fields are parameters of the same names, but for those that are changed."""
        names = {item.name for item in fields(kind)} & type(self).model_fields.keys()
        try:
            return kind(**{name: getattr(self, name) for name in names} | changed)
        except ValueError as error:
            raise Refused(422, str(error)) from None

    def cells(self, default: int, most: int) -> int:
        """Cells along the longest side; raises ``Refused`` (422) for too few or too many."""
        if self.resolution is None:
            return default
        if not 4 <= self.resolution <= most:
            raise Refused(
                422,
                f"resolution is {self.resolution}; it must be a whole number, from 4 to {most}: give for example 128",
            )
        return self.resolution


def sentence_of(error: ErrorDetails | dict[str, Any]) -> str:
    """Sentence about a parameter that pydantic refuses."""
    name = str(error["loc"][-1] if error["loc"][-1] != "query" else "query")
    if error["type"] == "extra_forbidden":
        known = ", ".join(field.alias or key for key, field in FrameOptions.model_fields.items())
        return f"there is no parameter {_brief(name)}; the parameters are {known}: correct the spelling"
    # what a list is of is named before the number in it
    names = [str(part) for part in error["loc"] if part != "query" and not isinstance(part, int)]
    rule = re.split("[,:]", re.sub("^(Input should be|Invalid|Value error,) ", "", error["msg"]))[0]
    return f"{names[0] if names else name} is {_brief(error.get('input'))}; it must be {rule}: correct it"


def _brief(value: Any) -> str:
    text = ascii(value)
    return text if len(text) <= 60 else f"{text[:60]}..."
