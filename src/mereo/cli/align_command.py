"""``mereo align``: see ``commands`` for how commands are written."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional


@dataclass(frozen=True)
class Align:
    """Place every segment of a model on a full-resolution scan, from a rough start: ground truth for `mereo evaluate`.

    Attributes:
        scan: point cloud (PLY, PCD, XYZ, NPY, NPZ) that shows this object alone, from one side.
        scene: a name from `mereo scene list`, or a scene file of your own (.yaml, .py).
        output: folder to create: truth.json, overlay.png, segments.glb.
        start: JSON file with poses or picked point pairs, of the object or of single segments.
        weights: instead of --start, a shipped name or a file: the network's guess. The truth is then not independent.
        unit: of the scan.
        scene_unit_mm: millimetres per scene unit, where the scene does not say.
        frame: axes of the scan: camera is x right, y down, z forward; scanner is y up, z toward the scanner.
        as_one: the object is rigid: place it as a whole.
        hold: segments to leave at their start or at their neighbour, whatever the scan shows.
        drop_invalid: leave out NaN, infinite and all-zero points instead of refusing the file.
        force: replace an existing output folder.
    """

    scan: Positional[Path]
    scene: str
    output: Path
    start: Path | None = None
    weights: str | None = None
    unit: Literal["m", "cm", "mm", "in"] = "m"
    scene_unit_mm: float | None = None
    frame: Literal["camera", "scanner"] = "camera"
    as_one: bool = False
    hold: tuple[str, ...] = ()
    drop_invalid: bool = False
    force: bool = False

    def run(self) -> None:
        from mereo.cli.align import align_file
        from mereo.evaluation.registration.truth_file import ScanFile

        align_file(
            ScanFile(self.scan, self.unit, self.frame, self.drop_invalid),
            self.scene,
            self.output,
            start=self.start,
            weights=self.weights,
            scene_unit_mm=self.scene_unit_mm,
            as_one=self.as_one,
            hold=self.hold,
            force=self.force,
        )
