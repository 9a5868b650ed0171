"""The command ``mereo reconstruct``. See ``mereo.cli.commands`` for how commands are written."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import UseAppendAction, arg

from mereo.cli.config_file import ConfigFile, options_of
from mereo.cli.object_option import MeshUnits
from mereo.cli.outcome import Outcome
from mereo.cli.positionals import Inputs
from mereo.fitting.config import AnswerMethod
from mereo.io.bounds import Cells, Threads
from mereo.io.config import CarryFrame, FilesConfig, InputConfig
from mereo.models.config import InferenceConfig
from mereo.reconstruction.config import IsolationConfig
from mereo.workers.config import ONE_CPU, RayAddress, TaskResources, cluster_of


@dataclass(frozen=True)
class ReconstructCommand:
    """Reconstruct all segments from a frame, a depth image, point cloud or ROS recording, or from many frames.

    Several frames, or folders of them, share one loading of the weights and all options. Each gets a folder of its own
    in --output, named by its file; one that cannot be answered is reported and skipped.

    The exit status is 0 where every frame is answered, 3 where an answer is not recognized as the object, 2 where a
    frame cannot be answered.

    Attributes:
        inputs: depth images (PNG, TIFF, EXR, NPY), point clouds (PLY, PCD, XYZ, NPY, NPZ, ZDF), ROS recordings (bag,
            MCAP; one frame of each), or folders of images and clouds; results are in each one's frame and units.
        object: what is looked for: its meshes, one file for each segment, one file of named parts or a label volume; a
            scene file, a built-in scene's name, or the folder of `mereo learn`. Nothing is trained for it.
        weights: a shipped name or a file; with --object they start the fit, without they say what is looked for.
        units: of the object's meshes; guessed where not given.
        output: folder to create, by default result, result2, ...; of several frames, the folder in which each one's is
            created.
        resolution: grid cells along the longest side.
        reading: how the frame is read.
        isolation: what of the frame is left out.
        inference: where and how exactly the network computes.
        files: which files, and in which unit.
        method: register the object's own deformation model to the frame: auto takes the registered model where it
            explains the frame, if the weights carry one; network leaves the network's answer, search the network out;
            modes and full take the model in any case, full by fitting the draws of the scene as well.
        scene: the scene's name or file, whose draws are fitted, where it is not the built-in one of the weights.
        carry: file to bring to where the object is, its inside included; once for each: mesh (STL, PLY, OBJ, GLB,
            glTF), points (PLY, PCD, XYZ, NPY), CSV (x, y, z; qx, qy, qz, qw or m00 to m23 for poses) or volume (NIfTI,
            NRRD), which is resampled around the object.
        carry_frame: frame and unit of these files: source is that of the object's own files, scene that of its scene.
        explain: segment, for its centroid, or place x,y,z in the input's frame and unit: print how sure the object's
            point there is and what leaves it unsure, and write the observed points coloured by how much each decides it
            (explained/1.ply, those that the model does not explain in red); once for each. The report has all segments.
        force: replace an existing output folder that mereo wrote, and nothing else is in.
        threads: of torch and all else that computes; 0 means one per core.
        ray: answer each of several frames in a task of a Ray cluster: local, one of so many --threads for this run;
            auto or HOST:PORT, the one that this machine is a node of.
        task: what each task has for itself.
        json: print the summary as one JSON object on standard output, of several frames a list of them in it, and all
            else on standard error.
        options_from: file of options, JSON or YAML, such as the config.json of a result; the command line wins over it.
    """

    inputs: Inputs
    object: tuple[str, ...] = ()
    weights: str | None = None
    units: MeshUnits = None
    output: Path | None = None
    resolution: Cells = 128
    reading: Annotated[InputConfig, arg(name="")] = field(default_factory=InputConfig)
    isolation: Annotated[IsolationConfig, arg(name="")] = field(default_factory=IsolationConfig)
    inference: Annotated[InferenceConfig, arg(name="")] = field(default_factory=InferenceConfig)
    files: Annotated[FilesConfig, arg(name="")] = field(default_factory=FilesConfig)
    method: AnswerMethod = "auto"
    scene: str | None = None
    carry: UseAppendAction[tuple[Path, ...]] = ()
    carry_frame: CarryFrame = "source"
    explain: UseAppendAction[tuple[str, ...]] = ()
    force: bool = False
    threads: Threads = 0
    ray: RayAddress = None
    task: Annotated[TaskResources, arg(name="")] = ONE_CPU
    json: bool = False
    options_from: ConfigFile = None

    def run(self) -> Outcome:
        """Write the folder of results and print the segments."""
        from mereo.api.result import free_folder
        from mereo.cli.reconstruct import FrameJob
        from mereo.cli.reconstruct_many import reconstruct_inputs
        from mereo.workers.cluster import joined_first

        cluster = cluster_of(self.ray, self.threads, self.task)
        inference = self.inference
        if cluster is not None and self.weights is not None:
            from mereo.models.elsewhere import for_tasks

            inference = for_tasks(inference, cluster)
        job = FrameJob(
            self.weights,
            self.resolution,
            self.reading,
            self.isolation,
            inference,
            self.files,
            self.method,
            self.scene,
            self.carry,
            self.carry_frame,
            self.force,
            self.explain,
            options_of(self, "reconstruct"),
            looked_for=self.object,
            units=self.units,
        )
        with joined_first(cluster):
            return reconstruct_inputs(self.inputs, self.output or free_folder(), job, cluster)
