"""The commands that answer frames: reconstruct, view, stream, serve.

Those of reconstruct and stream are options alone, so that help is instant: their work lies in the modules of these
names, which know them, and ``__main__`` joins both.
"""

from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from tyro.conf import UseAppendAction

from mereo.cli.options import ConfigFile, FrameOptions, InputName, InputOrNone, Inputs, Paths, loaded_object
from mereo.fitting.config import AnswerMethod, StreamMethod
from mereo.io.bounds import GROUP, Cells, Instances, Port, Positive, Threads, Workers
from mereo.io.config import CarryFrame, FilesConfig
from mereo.models.config import InferenceConfig
from mereo.workers.spread import DEFAULT_TASK, RayAddress, TaskResources
from mereo_serving.config import ServeConfig

SERVE_MODULES = ("fastapi", "uvicorn", "prometheus_client", "python_multipart")
"""Modules of the extra `serve`."""


@dataclass(frozen=True)
class ReconstructCommand(FrameOptions):
    """Reconstruct all segments from a frame, a depth image, point cloud or ROS recording, or from many frames.

    Several frames, or folders of them, share one loading of the weights and all options. Each gets a folder of its own
    in --output, named by its file; one that cannot be answered is reported and skipped.

    The exit status is 0 where every answer is recognized as the object, 4 where one is doubtful or was not checked (the
    network alone), 3 where one is not the object, 2 where a frame cannot be answered.

    Attributes:
        inputs: depth images (PNG, TIFF, EXR, NPY), point clouds (PLY, PCD, XYZ, NPY, NPZ, ZDF), meshes (STL, OBJ, GLB,
            PLY) of surfaces that no single camera saw, ROS recordings (bag, MCAP; one frame of each), or folders of
            images and clouds; results are in each one's frame and units.
        object: what is looked for: its meshes, one file for each segment, one file of named parts, a robot's URDF,
            SDF or MJCF file or a label volume; a scene file, a built-in scene's name, or the folder of `mereo learn`.
            Nothing is trained for it.
        output: folder to create, by default result, result2, ...; of several frames, the folder in which each one's is
            created.
        resolution: grid cells along the longest side.
        files: which files, and in which unit.
        method: auto registers the object's model by a search that begins at a network's guess, if there are weights;
            search leaves the network out; network takes its surfaces alone; modes leaves the parameters of the scene
            out.
        scene: the scene's name or file, whose draws are fitted, where it is not the built-in one of the weights.
        initial_pose: file of the object's rough pose, from which the fit starts instead of a search or a network: 4 x 4
            numbers (text, NPY, or the summary.json of a result) that take the object's own files, in the frame's unit,
            to the frame. Parts that the scene holds stay there.
        joints: file (YAML, JSON) of joints whose values are known, as by encoders, in all frames: NAME: VALUE, or NAME:
            {value: VALUE, within: ERROR}, in radians, or metres of joints that slide; or what `ros2 topic echo --once
            /joint_states` prints. Only the others are looked for.
        instances: how many of the object are looked for in a whole depth image, or all; further ones that are known get
            folders of their own in the output.
        carry: file to bring to where the object is, its inside included; once for each: mesh (STL, PLY, OBJ, GLB),
            points (PLY, XYZ, NPY), CSV (x, y, z; qx, qy, qz, qw for poses) or volume (NIfTI, NRRD), which is
            resampled around the object.
        carry_frame: frame and unit of these files: source is that of the object's own files, scene that of its scene;
            RAS and LPS state the space of the object's own files, where these do not name it.
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
    output: Path | None = None
    resolution: Cells = 128
    files: Annotated[FilesConfig, GROUP] = field(default_factory=FilesConfig)
    method: AnswerMethod = "auto"
    scene: str | None = None
    initial_pose: Path | None = None
    instances: Instances = 1
    carry: UseAppendAction[Paths] = ()
    carry_frame: CarryFrame = "source"
    force: bool = False
    threads: Threads = 0
    ray: RayAddress = None
    task: Annotated[TaskResources, GROUP] = DEFAULT_TASK
    json: bool = False
    options_from: ConfigFile = None


@dataclass(frozen=True)
class ViewCommand(FrameOptions):
    """Look at a frame and its reconstruction in a browser, or try an object (--object): needs the extra `view`.

    Only this machine reaches the page; from another one use a tunnel: ssh -L 8080:127.0.0.1:8080 HOST.

    Attributes:
        input: a point cloud or depth image, as for `mereo reconstruct`, or the folder of a result of it; a GLB file;
            without it (and --object) a shipped frame.
        object: what is looked for in the frame, as for `mereo reconstruct`: its meshes or its scene. Without a frame
            the laboratory of this object is opened: states of its are shown to a simulated camera, and what is found in
            its image next to the truth.
        weights: a shipped name or a file; by default those of the shipped frame, or none.
        port: where the page is; 0 takes any that is free.
        resolution: grid cells along the longest side.
    """

    input: InputOrNone = None
    port: Port = 8080
    resolution: Cells = 128

    def run(self) -> None:
        """Open a page, and keep it until Ctrl-C."""
        from mereo.api.view import view
        from mereo.io.progress import shown_stages
        from mereo.synthesis.sample_views import shipped_views
        from mereo_viewer.server import import_viser

        import_viser()  # its absence is better said before the work
        input = self.input
        known = None
        if input is None and not self.object and self.weights is not None:
            if self.weights not in shipped_views():
                raise ValueError(
                    f"there is no frame to show and none is shipped for {self.weights!r}; name a depth image or a "
                    f"point cloud, or take the weights of a shipped frame: {', '.join(shipped_views())}"
                )
            input = Path(self.weights)
        if self.object or self.weights is not None:
            with shown_stages():
                known = loaded_object(self)
        view(
            input,
            known,
            reading=self.reading,
            isolation=self.isolation,
            resolution=self.resolution,
            port=self.port,
            block=True,
        )


@dataclass(frozen=True)
class StreamCommand(FrameOptions):
    """Reconstruct frames as they come: the latest one wins, a bad one is reported and passed over.

    Each answer is one line of JSON on standard output, in the input's frame and units; rate and latency come at the
    end, on standard error. Where the object's own deformation model is known, it is followed: each frame's fit starts
    from the last one's state, and a search answers at first and where the object is lost. The exit status is
    0 where any frame was answered and the sequence was whole, else 2.

    Attributes:
        input: a folder of depth images or point clouds, a ROS recording, or - for file names on standard input;
            realsense for a camera that is connected, realsense:SERIAL for a certain one, realsense:FILE for a recording
            of its SDK: these need the extra `realsense`.
        joints: file of joints whose values are known and stay as they are, as for `mereo reconstruct`; or a folder of
            such files, one for each frame, 0000.yaml for 0000.png; or a ROS recording's topic of JointState.
        resolution: grid cells along the longest side of the network's surfaces: fewer are faster.
        method: auto follows the registered model, which a search finds from a network's guess, if there are weights;
            search leaves the network out; network uses it alone, frame by frame.
        radius: say how sure the registered model is of the object's surface, which takes some 30 ms.
        uncertainty: say how sure the registered model is of each segment, too: the radius, in the input's unit, that
            holds the true place of its centroid with probability 0.95, and the interval of its volume.
        rate: frames per second at which a folder was recorded.
        every_frame: answer all frames, however long it takes, instead of the latest.
        watch: the folder is still filled: answer its files as they arrive or are written again, until Ctrl-C.
        align_color: of a RealSense, take depth as its colour camera sees it: results are in the axes of that.
        surfaces: folder for the surfaces of each answered frame, one GLB file each; one with content is refused.
        force: write into a folder with content, and replace the files of the same names in it.
        threads: of torch and all else that computes; 0 means one per core.
    """

    input: InputName
    resolution: Cells = 48
    method: StreamMethod = "auto"
    radius: bool = True
    uncertainty: bool = False
    rate: Positive = 30.0
    every_frame: bool = False
    watch: bool = False
    align_color: bool = False
    surfaces: Path | None = None
    force: bool = False
    threads: Threads = 0


@dataclass(frozen=True)
class ServeCommand:
    """Answer frames of many clients over HTTP: a depth image or cloud in, JSON or GLB out: needs the extra `serve`.

    POST a frame to /v1/NAME/reconstruct; /docs says how, /metrics has numbers for Prometheus. TERM and Ctrl-C answer
    what is begun and refuse the rest.

    Attributes:
        object: meshes, joined by commas, or a scene, once for each object that has no weights; NAME=FILE,FILE says what
            clients call it.
        weights: a shipped name or a file, once for each object that has them; NAME=FILE says what clients call it.
        scene: NAME=FILE of the scene whose draws are fitted, where it is not the built-in one of the weights; once for
            each.
        method: auto registers the object's model by a search that begins at a network's guess, if there are weights;
            search leaves the network out; network takes its surfaces alone; modes leaves the parameters of the scene
            out.
        port: where it listens; 0 takes any that is free.
        host: address of this machine. Only this machine reaches the default. Another one needs the token of the address
            that is printed, and others on the network can read along: a proxy that encrypts is safer.
        resolution: grid cells along the longest side, where a request does not say.
        limits: so that no client, and no crowd of them, takes more than the machine has.
        inference: where and how exactly the networks compute.
        workers: processes that answer, each with all weights and one thread; 0 means one per core.
    """

    object: UseAppendAction[tuple[str, ...]] = ()
    weights: UseAppendAction[tuple[str, ...]] = ()
    scene: UseAppendAction[tuple[str, ...]] = ()
    method: AnswerMethod = "auto"
    port: Port = 8000
    host: str = "127.0.0.1"
    resolution: Cells = 128
    limits: Annotated[ServeConfig, GROUP] = field(default_factory=ServeConfig)
    inference: Annotated[InferenceConfig, GROUP] = field(default_factory=InferenceConfig)
    workers: Workers = 0

    def run(self) -> None:
        """Serve until a signal asks for the end."""
        if missing := [name for name in SERVE_MODULES if find_spec(name) is None]:
            raise ImportError(f"{missing[0]} is not installed; `mereo serve` needs it: run pip install 'mereo[serve]'")
        from mereo.io.cores import cores
        from mereo_serving.server import serve, served_objects

        serve(
            served_objects(self.weights, self.scene, self.object),
            method=self.method,
            resolution=self.resolution,
            address=(self.host, self.port),
            workers=self.workers or cores(),
            config=self.limits,
            inference=self.inference,
        )
