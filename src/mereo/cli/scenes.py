"""The commands ``mereo scene ...`` and ``mereo assets ...``: scenes of objects, and meshes and scans to download."""

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from mereo.cli.options import AssetNames, ObjectFiles, SceneName
from mereo.io.bounds import GROUP, Aperture, CountOrNone, States
from mereo.io.config import MeshesConfig
from mereo.synthesis.config import SENSORS, Sensor, SequenceConfig

if TYPE_CHECKING:
    from mereo.scenes.statistical_model import StatisticalModel

SHARES = (0.9, 0.95, 0.99, 0.999)
"""Shares of the variance for which the number of modes is printed."""

ENOUGH = 0.1
"""Distance in scene units that modes may leave of a state: the noise of the paper's sensor."""


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
        files: one mesh for each segment (STL, PLY, OBJ, OFF), one file of named parts (GLB, OBJ, 3MF), a robot (URDF,
            SDF, MJCF), one label volume (NIfTI, NRRD), or one for each segment.
        output: the YAML file; by default called after the first file, in the working directory.
        aperture: of the cone of directions from which your camera looks, about the side that is up, in degrees; 360 is
            all around, with any roll.
        meshes: what the files do not say.
    """

    files: ObjectFiles
    output: Path | None = None
    aperture: Aperture = 360.0
    meshes: Annotated[MeshesConfig, GROUP] = field(default_factory=MeshesConfig)

    def run(self) -> None:
        """Write the scene file, and print what was found and what to do next."""
        from mereo.scenes.files.template import write_scene_file

        path = write_scene_file(self.files, self.output, aperture=self.aperture, report=print, **vars(self.meshes))
        named = shlex.quote(str(path))
        print(f"wrote {path}; read it, then:")
        print(f"  mereo scene check {named}")
        print(f"  mereo scene preview {named} --output states.png")


@dataclass(frozen=True)
class SceneCheck:
    """Check every segment (closed, outward oriented, no self-intersection), overlaps, the unit, and random states.

    Attributes:
        scene: a name from `mereo scene list`, or a scene file of your own (.yaml, .py).
        repair: write repaired copies of faulty meshes, and a scene file that names them, next to a YAML scene file.
    """

    scene: SceneName
    repair: bool = False

    def run(self) -> None:
        """Print what is found, and write repaired copies where asked to."""
        from mereo.scenes.files.check import check_scene

        check_scene(self.scene, self.repair)


@dataclass(frozen=True)
class ScenePreview:
    """Draw nine random states of a scene, each with its camera and depth image.

    Attributes:
        scene: a name from `mereo scene list`, or a scene file of your own (.yaml, .py).
        output: the picture, a PNG file.
        seed: another seed shows other states.
        force: replace an existing file, unless the scene is read from it.
    """

    scene: SceneName
    output: Path
    seed: CountOrNone = 0
    force: bool = False

    def run(self) -> None:
        """Write the picture of random states."""
        from mereo.io.atomic_files import atomic_file, check_file_place
        from mereo.scenes.registry import files_of, load_scene
        from mereo.visualization.previews import preview_scene

        check_file_place(self.output, force=self.force)
        with atomic_file(self.output, force=self.force, inputs=files_of(self.scene)) as partial:
            preview_scene(load_scene(self.scene), partial, self.seed)
        print(f"wrote {self.output}")


@dataclass(frozen=True)
class SceneModes:
    """Say how many modes an object's states need.

    Attributes:
        scene: a name from `mereo scene list`, a scene file of your own (.yaml, .py), or weights that carry a model
            (.safetensors).
        states: random states from which the model of a scene is built.
    """

    scene: SceneName
    states: States = 1500

    def run(self) -> None:
        """Print how many modes are needed."""
        name, model = self._model()
        print(f"{name}: {model.count} modes of {len(model.library)} states, and what they leave of an unseen one (rms)")
        for share in SHARES:
            number = int((model.explained < share).sum()) + 1
            if number <= model.count:
                print(f"{share:6.1%} of the variance: {number:4} modes, {model.residues[number]:.3f} units left")
        print(f"             all modes: {model.count:4} modes, {model.residue:.3f} units left")
        count = model.modes_for(ENOUGH)
        print(
            f"even all modes leave {model.residue:.3f} units, more than {ENOUGH}, the noise of the paper's sensor: the "
            "states lie on a curved set, so the scene's own draws fit better"
            if count is None
            else f"{count} modes leave at most {ENOUGH} units, the noise of the paper's sensor"
        )

    def _model(self) -> "tuple[str, StatisticalModel]":
        """Name and statistical model of a scene, or those that weights carry."""
        from mereo.models.weights import load_model
        from mereo.scenes.random_states import LEAST_STATES, scene_model
        from mereo.scenes.registry import load_scene

        if self.scene.endswith(".safetensors"):
            network = load_model(self.scene)
            if network.statistical_model is None:
                raise ValueError(
                    f"{self.scene} carries no statistical model: name the scene that it was trained on instead"
                )
            return str(network.provenance.get("scene")), network.statistical_model
        if self.states < LEAST_STATES:
            raise ValueError(
                f"{self.states} states are asked for; fewer than {LEAST_STATES} say little: leave --states out"
            )
        loaded = load_scene(self.scene)
        return loaded.name, scene_model(loaded, self.states, quiet=False)


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
        from mereo.io.writers.meshes import write_segments_ply
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
    settings: Annotated[SequenceConfig, GROUP] = field(default_factory=SequenceConfig)
    sensor: Sensor = "paper"
    seed: CountOrNone = 0
    test: bool = False
    force: bool = False

    def run(self) -> None:
        """Write the folder, and print how it is answered."""
        from mereo.io.atomic_files import new_directory
        from mereo.scenes.registry import files_of, load_scene
        from mereo.synthesis.recording import training_seed, write_recording

        seed = training_seed(self.seed, self.test)
        with new_directory(self.output, self.force, files_of(self.scene)) as folder:
            scene = load_scene(self.scene)
            sensor = (self.sensor, SENSORS[self.sensor])
            write_recording(folder, scene, self.settings, sensor, seed, named=self.scene)
        print(f"wrote {self.output}: {self.settings.frames} frames in {self.settings.seconds:g} s; then:")
        command = f"mereo stream {shlex.quote(str(self.output))} --rate {self.settings.rate:g}"
        print(f"  {command} --object {shlex.quote(self.scene)}")


@dataclass(frozen=True)
class AssetsList:
    """Name the downloadable meshes and scans, with licence and credit."""

    def run(self) -> None:
        """Print every asset with its licence, credit and place."""
        from mereo_objects.assets import ASSETS, location

        for asset in ASSETS.values():
            print(f"{asset.name}\n  {asset.description}\n  {asset.licence}; credit: {asset.credit}")
            print(f"  {location(asset.name) or 'not here yet'}")


@dataclass(frozen=True)
class AssetsGet:
    """Download assets, check them, and print where they are.

    Attributes:
        names: from `mereo assets list`; none means all of them.
    """

    names: AssetNames = ()

    def run(self) -> None:
        """Fetch assets and print where they are."""
        from mereo_objects.assets import ASSETS, get

        for name in self.names or ASSETS:
            print(get(name))
