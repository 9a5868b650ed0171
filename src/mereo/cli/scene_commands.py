"""The commands ``mereo scene ...``: list, write, check, draw, record and export scenes.

See ``mereo.cli.commands`` for how commands are written.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from mereo.cli.positionals import ObjectFiles, SceneName, SceneNameOrNone
from mereo.io.bounds import CountOrNone, States
from mereo.synthesis.config import SENSORS, Sensor
from mereo.synthesis.sequence_config import SequenceConfig


@dataclass(frozen=True)
class SceneList:
    """Name the built-in scenes."""

    def run(self) -> None:
        """Print the names of the built-in scenes."""
        from mereo.scenes.scene import SCENES

        for name in SCENES:
            print(name)


@dataclass(frozen=True)
class SceneNew:
    """Write a scene file for an object of your own, with every choice explained in comments.

    Attributes:
        files: one mesh for each segment (STL, PLY, OBJ, OFF), one file of named parts (GLB, OBJ, 3MF), or one label
            volume (NIfTI, NRRD).
        output: the YAML file; by default called after the first file, in the working directory.
        units: of the files; guessed where not given.
    """

    files: ObjectFiles
    output: Path | None = None
    units: Literal["mm", "cm", "m", "in"] | None = None

    def run(self) -> None:
        """Write the scene file, and print what to do next."""
        from mereo.scenes.files.template import write_scene_file

        path = write_scene_file(self.files, self.output, self.units)
        print(f"wrote {path}; read it, then:")
        print(f"  mereo scene check {path}")
        print(f"  mereo scene preview {path} --output states.png")


@dataclass(frozen=True)
class SceneCheck:
    """Check every segment (closed, outward oriented, no self-intersection), overlaps, the unit, and random states.

    Attributes:
        scene: a name from `mereo scene list`, or a scene file of your own (.yaml, .py).
        repair: write repaired copies of faulty meshes, and a scene file that names them, beside a YAML scene file.
    """

    scene: SceneName
    repair: bool = False

    def run(self) -> None:
        """Print what is found, and write repaired copies where asked to."""
        from mereo.scenes.files.check import check_scene

        check_scene(self.scene, self.repair)


@dataclass(frozen=True)
class ScenePreview:
    """Draw nine random states of a scene, each with its camera and depth image; or all built-in scenes on one sheet.

    Attributes:
        output: the picture, a PNG file.
        scene: a name from `mereo scene list`, or a scene file of your own (.yaml, .py).
        all: draw every built-in scene: at rest, two random states and a depth image.
        seed: another seed shows other states.
        force: replace an existing file, unless the scene is read from it.
    """

    output: Path
    scene: SceneNameOrNone = ""
    all: bool = False
    seed: CountOrNone = 0
    force: bool = False

    def run(self) -> None:
        """Write the picture of random states."""
        from mereo.io.atomic_files import atomic_file, check_file_place
        from mereo.scenes.registry import files_of, load_scene
        from mereo.visualization.previews import preview_all, preview_scene

        check_file_place(self.output, force=self.force)
        if self.all == bool(self.scene):
            given = f"both {self.scene!r} and --all are" if self.all else "neither a scene nor --all is"
            raise ValueError(f"{given} given; one of them is needed: name a scene, or give --all")
        read = files_of(self.scene or "rope")  # of all built-in scenes these are the same: the assets
        with atomic_file(self.output, force=self.force, inputs=read) as partial:
            if self.all:
                preview_all(partial, self.seed)
            else:
                preview_scene(load_scene(self.scene), partial, self.seed)
        print(f"wrote {self.output}")


@dataclass(frozen=True)
class SceneModes:
    """Draw the modes in which an object deforms, and say how many its states need.

    Attributes:
        scene: a name from `mereo scene list`, a scene file of your own (.yaml, .py), or weights that carry a model
            (.safetensors).
        output: the picture, a PNG file; without it only the numbers are printed.
        states: random states from which the model of a scene is built.
        force: replace an existing file, unless the scene or the weights are read from it.
    """

    scene: SceneName
    output: Path | None = None
    states: States = 1500
    force: bool = False

    def run(self) -> None:
        """Print how many modes are needed, and write the picture."""
        from mereo.cli.modes import show_modes

        show_modes(self.scene, self.output, self.states, self.force)


@dataclass(frozen=True)
class SceneExport:
    """Write a scene's segments at rest, in scene units: to look at, or to pick points in for `mereo align`.

    Attributes:
        scene: a name from `mereo scene list`, or a scene file of your own (.yaml, .py).
        output: a PLY file (one mesh, coloured), or a GLB file (a node for each segment).
        force: replace an existing file, unless the scene is read from it.
    """

    scene: SceneName
    output: Path
    force: bool = False

    def run(self) -> None:
        """Write the mesh file of the segments at rest."""
        import numpy as np

        from mereo.io.atomic_files import atomic_file, check_file_place
        from mereo.io.writers.glb import write_segments_glb
        from mereo.io.writers.ply import write_segments_ply
        from mereo.scenes.registry import files_of, load_scene

        check_file_place(self.output, force=self.force)
        suffix = self.output.suffix.lower()
        if suffix not in (".ply", ".glb"):
            raise ValueError(f"{self.output} has the suffix {suffix!r}; it must be .ply or .glb: rename it")
        rest = load_scene(self.scene).rest
        with atomic_file(self.output, force=self.force, inputs=files_of(self.scene)) as partial:
            if suffix == ".ply":
                write_segments_ply(partial, rest)
            else:
                write_segments_glb(partial, rest, np.eye(3))
        print(f"wrote {self.output}")


@dataclass(frozen=True)
class SceneRecord:
    """Record a sequence of a scene as a depth camera's frames, with the truth of each: for `mereo stream` and `view`.

    The object walks smoothly through its own random states, the camera moves a little, and a tool passes in front.

    Attributes:
        scene: a name from `mereo scene list`, or a scene file of your own (.yaml, .py).
        output: folder to create: frames/*.png, camera.json, truth.npz, recording.json.
        settings: how long, how fast, and what hides the object.
        sensor: whose errors the frames have: the paper's noise, or those of a kind of depth camera.
        seed: another seed, another sequence; seeds from 1,000,000 up are for testing.
        test: allow a test seed.
        force: replace an existing output folder that mereo wrote, and nothing else is in.
    """

    scene: SceneName
    output: Path
    settings: Annotated[SequenceConfig, arg(name="")] = field(default_factory=SequenceConfig)
    sensor: Sensor = "paper"
    seed: CountOrNone = 0
    test: bool = False
    force: bool = False

    def run(self) -> None:
        """Write the folder, and print how it is answered."""
        from mereo.io.output_folders import new_directory
        from mereo.scenes.registry import files_of, load_scene
        from mereo.synthesis.recording import training_seed, write_recording

        seed = training_seed(self.seed, self.test)
        with new_directory(self.output, self.force, files_of(self.scene)) as folder:
            scene, sensor = load_scene(self.scene), (self.sensor, SENSORS[self.sensor])
            index = write_recording(folder, scene, self.settings, sensor, seed, named=self.scene)
        print(f"wrote {self.output}: {len(index.frames)} frames in {self.settings.seconds:g} s; then:")
        print(f"  mereo stream {self.output} --rate {index.rate_hz:g} --weights WEIGHTS")
