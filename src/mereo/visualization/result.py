"""Result of one frame: an answer with what it was given, to be looked at, saved, and opened in the browser.

    Result -save-> a folder as of `mereo reconstruct`, or one file
           -show-> a page in the browser

``visualization.answering`` makes it of a frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING

from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.carry import Carried
from mereo.fitting.registration.register import Registrar, describe
from mereo.fitting.registration.state import write_state
from mereo.geometry.scanner_axes import camera_axes
from mereo.geometry.transforms import transform_points
from mereo.io.atomic_files import atomic_file
from mereo.io.config import DEFAULT_FILES, FilesConfig, Format
from mereo.io.output_folders import new_directory
from mereo.io.ros_recordings import is_recording
from mereo.io.writers.formats import chosen_formats
from mereo.models.model import Model
from mereo.reconstruction.observation import Observation
from mereo.visualization.result_files import write_files, write_one
from mereo.visualization.result_html import result_html
from mereo.visualization.result_scene import scene_facts
from mereo.visualization.units import UNKNOWN, Unit

if TYPE_CHECKING:
    from mereo.visualization.viewer.open_page import OpenPage

SINGLE = (".glb", ".ply", ".npz", ".vti", ".nii.gz", ".seg.nrrd", ".json", ".html", ".png")
"""Suffixes of the files that ``Result.save`` writes alone."""


@dataclass(frozen=True, eq=False, repr=False)
class Result(Answer):
    """Answer to one frame with all that it was made from; what it found is as in ``Answer``.

    Attributes:
        seen: the object in the frame: the points that were taken for its, in the frame's axes and unit.
        model: the weights.
        registrar: of the object's own model; None where the network alone was asked.
        resolution: cells along the longest side of the object's box.
        unit_stated: whether the metres in the frame's unit were given, by its file or by the caller.
    """

    seen: Observation = field(kw_only=True)
    model: Model = field(kw_only=True)
    registrar: Registrar | None = field(default=None, kw_only=True)
    resolution: int = field(default=128, kw_only=True)
    unit_stated: bool = field(default=True, kw_only=True)

    @classmethod
    def of(
        cls,
        found: Answer,
        seen: Observation,
        model: Model,
        registrar: Registrar | None,
        resolution: int,
        unit_stated: bool = True,
    ) -> "Result":
        """Result of an answer; the arguments are the attributes of the same names, ``seen`` with strays or without."""
        given = {item.name: getattr(found, item.name) for item in fields(Answer)}
        return cls(
            **given,
            seen=seen.read_as(found.reconstruction.reading),
            model=model,
            registrar=registrar,
            resolution=resolution,
            unit_stated=unit_stated,
        )

    @property
    def unit(self) -> Unit:
        """Unit of all lengths, for people: as it was stated, or by the true size of the registered model."""
        if self.unit_stated and self.seen.frame.unit_stated:
            return Unit(self.seen.frame.unit_m)
        if self.taken and self.registration is not None:
            source = self.registration.model.source_frame
            if source is not None and source.unit_m is not None:
                return Unit(source.unit_m / self.registration.scene_unit)
        return UNKNOWN

    def facts(self, carried: Sequence[Carried] = ()) -> dict[str, object]:
        """What the summary of a folder of results says first."""
        told: dict[str, object] = {
            "title": self.seen.frame.source,
            "weights": self.model.name,
            "resolution": self.resolution,
            "points": len(self.seen.cloud),
        }
        if self.registrar is not None:
            told["registration"] = registration_facts(self)
        told["recognition"] = self.recognition.facts()
        told |= {"device": self.model.device.type, "precision": self.model.working_precision}
        if carried:
            told["carried"] = [one.facts() for one in carried]
        return {**told, **self.seen.facts()}

    def write(self, directory: Path, files: FilesConfig = DEFAULT_FILES, carried: Sequence[Carried] = ()) -> None:
        """Write what `mereo reconstruct` does into a directory that is there."""
        frame = self.seen.frame
        facts = self.facts(carried) | scene_facts(None if self.registrar is None else self.registrar.given)
        write_files(
            directory,
            self.reconstruction,
            self.seen.cloud,
            frame.axes,
            files,
            frame.unit_m,
            facts,
            carried,
            self.unit,
            self.registered,
        )
        write_state(directory, self, self.registrar, self.model.name, frame.axes, frame.unit_m)

    def save(
        self,
        path: str | Path,
        *,
        formats: Sequence[Format] | None = None,
        millimetres: bool = False,
        force: bool = False,
    ) -> Path:
        """Write a folder of results as `mereo reconstruct` does, or one file; returns its path.

        Args:
            path: a folder to create; or a file whose suffix says what it is: .glb, .ply (surfaces), .npz, .vti,
                .nii.gz, .seg.nrrd (labels), .json (the figures), .html (the report), .png (the preview).
            formats: files of a folder beside report and preview, as ``--formats``; "points" needs
                ``answer(..., label_points=True)``.
            millimetres: write .ply, .vti and other files that have no unit in millimetres, not in the frame's unit.
            force: replace a folder that mereo wrote, and nothing else is in, or a file that no input is.

        Raises ``FileExistsError`` for what exists, unless ``force`` may replace it; ``ValueError`` for a suffix or a
        format that there is none of, and ``ImportError`` where a format's extra is missing.
        """
        path = Path(path)
        suffix = file_suffix(path)
        if suffix == "":
            wanted = chosen_formats(DEFAULT_FILES.formats if formats is None else formats)
            files = FilesConfig(wanted, millimetres)
            with new_directory(path, force, self._read()) as directory:
                self.write(directory, files)
        elif formats is not None:
            raise ValueError(f"{path} is one file, whose suffix says its format: leave out formats, or name a folder")
        else:
            frame = self.seen.frame
            with atomic_file(path, force=force, inputs=self._read()) as partial:
                files, facts = FilesConfig((), millimetres), self.facts()
                cloud = self.seen.cloud
                write_one(
                    partial,
                    suffix,
                    self.reconstruction,
                    cloud,
                    frame.axes,
                    files,
                    frame.unit_m,
                    facts,
                    self.unit,
                    self.registered,
                )
        return path

    def show(self, *, port: int | None = None, host: str = "127.0.0.1", block: bool | None = None) -> "OpenPage":
        """Open the viewer on this result, as `mereo view` does, and print its address.

        Args:
            port: where the page is; by default any that is free.
            host: address of this machine that the page is at; only this machine reaches the default.
            block: wait until Ctrl-C; by default everywhere but in a notebook or an interactive session, where the page
                stays open until ``close()`` of what is returned, which a notebook shows as a frame.

        Raises ``ImportError`` without the extra `view`, and ``OSError`` for a port that is taken.
        """
        from mereo.visualization.viewer.result_page import open_answer

        page = open_answer(self, self.seen, self.model, self.registrar, self.unit, port=port or 0, host=host)
        return page.stay(block)

    def _read(self) -> list[Path]:
        """Files that this was made from."""
        places = [self.seen.frame.path, Path(self.model.name)]
        return [place for place in places if place.is_file() or is_recording(place)]

    def __repr__(self) -> str:
        segments = self.reconstruction.segments
        found = f"{sum(segment.voxels > 0 for segment in segments)} of {len(segments)} segments"
        return f"Result({self.seen.frame.source!r}: {found}; {self.source}; {self.reconstruction.seconds:.1f} s)"

    def _repr_html_(self) -> str:
        """What a notebook shows: the points seen on what was found, from two sides, and the segments in figures."""
        to_camera = camera_axes(self.seen.frame.axes)
        points = transform_points(to_camera, self.seen.cloud.points)
        surfaces = self.reconstruction.surfaces.transformed(to_camera)
        told = self.recognition.told
        lines = [self.source, *([] if told is None or self.registrar is None else [told])]
        found, title = self.reconstruction, self.seen.frame.source
        return result_html(title, lines, points, surfaces, found.segments, self.unit, found.calibrated)


def registration_facts(found: Answer) -> dict[str, object]:
    """Facts about where an answer comes from, for a summary."""
    source = "registration" if found.taken else "network"
    if found.registration is None:
        return {"answer": source, "refusal": found.refusal}
    return {"answer": source, **describe(found.registration)}


def file_suffix(path: Path) -> str:
    """Suffix of ``SINGLE`` that a path has, "" for a folder; raises ``ValueError`` for what looks like another file."""
    for suffix in SINGLE:
        if path.name.lower().endswith(suffix):
            return suffix
    if path.suffix[1:2].isalpha() and not path.is_dir():
        raise ValueError(
            f"{path} has the suffix {path.suffix!r}; one file is {', '.join(SINGLE)}: choose one of these, or name a "
            "folder without a suffix, which takes all formats"
        )
    return ""
