"""What the laboratory hands out: the frame and its result, each as one archive, which a browser puts beside others.

Nothing is written but in a folder of its own that goes away again, so nobody's file can be replaced.
"""

import io
import json
import re
import zipfile
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mereo.evaluation.sample_views import GUESSED_UNIT_M
from mereo.fitting.registration.answer import Answer
from mereo.io.intrinsics import written_intrinsics
from mereo.io.output_folders import new_directory
from mereo.io.writers.ply import write_positions_ply
from mereo.scenes.scene import Scene
from mereo.synthesis.examples import View
from mereo.visualization.result_files import write_answer


def file_name(scene: Scene, what: str) -> str:
    """Name of a file to be handed out, of letters and digits alone."""
    return f"{re.sub(r'[^A-Za-z0-9]+', '-', scene.name).strip('-') or 'scene'}-{what}"


def frame_archive(scene: Scene, view: View) -> bytes:
    """Depth image with its camera, and the same as a cloud, all in metres, as `mereo reconstruct` reads them."""
    unit_m = scene.unit_m or GUESSED_UNIT_M
    said = "of the true size" if scene.unit_m else "a guess, because the true size is not known"
    with TemporaryDirectory() as place:
        folder = Path(place) / file_name(scene, "frame")
        folder.mkdir()
        np.save(folder / "depth.npy", (view.depth.depth * unit_m).astype(np.float32))
        (folder / "camera.json").write_text(json.dumps(written_intrinsics(view.depth.camera), indent=2) + "\n", "utf-8")
        write_positions_ply(folder / "cloud.ply", view.depth.to_points().points * unit_m, comment="unit: metres")
        (folder / "README.txt").write_text(
            f"A depth image of the scene {scene.name!r}, in metres, 0 where nothing was measured; cloud.ply has "
            f"the same points.\nA scene unit is {unit_m:g} m ({said}).\n\n"
            "mereo reconstruct depth.npy --intrinsics camera.json --weights WEIGHTS --output result\n",
            "utf-8",
        )
        return zipped(folder)


def result_archive(scene: Scene, answer: Answer) -> bytes:
    """Folder of results as `mereo reconstruct` writes it."""
    frame = replace(answer.seen.frame, path=Path(scene.name), message="laboratory")
    named = replace(answer, seen=replace(answer.seen, frame=frame))
    with TemporaryDirectory() as place:
        folder = Path(place) / file_name(scene, "result")
        with new_directory(folder) as directory:
            write_answer(directory, named)
        return zipped(folder)


def zipped(folder: Path) -> bytes:
    """Archive of a folder, which unpacks to a folder of its name."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            archive.write(path, path.relative_to(folder.parent).as_posix())
    return content.getvalue()
