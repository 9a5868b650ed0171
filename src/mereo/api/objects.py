"""Objects that can be found in frames, with what is needed for it loaded once.

meshes, scene, folder or weights -load_object-> Object -registrar-> Registrar of a method

Meshes are enough: their scene bends them as if they were of rubber, and a search finds the object. Weights, where there
are any, start the fit at once and tell segments apart that look alike; only they need torch.
"""

import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from mereo.api.words import check_names, names_of, python_words
from mereo.deformation.samplers import RandomMotion
from mereo.fitting.config import AnswerMethod
from mereo.fitting.registration.register import Registrar, other_mesh, registrar_for
from mereo.geometry.conventions import LengthUnit, Names, Range, Way
from mereo.geometry.mesh import SegmentedMesh
from mereo.io.bounds import check_value
from mereo.io.config import MeshesConfig, RobotMeshes
from mereo.io.errors import AnyPath, checked_path, value_text
from mereo.io.extras import network_needed
from mereo.io.mesh_formats import MESH_SUFFIXES
from mereo.io.point_arrays import mesh_of
from mereo.io.progress import stage
from mereo.io.writers.meshes import write_segments_obj
from mereo.models.config import InferenceConfig
from mereo.models.trained import Trained
from mereo.models.weights_place import has_network, is_weights, statistical_model_in
from mereo.scenes.files.object_files import SCENE, names_scene, scene_of_folder, scene_of_meshes, shapes_in
from mereo.scenes.parameters import narrowed_model, with_joints
from mereo.scenes.random_states import kept_model
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES, AssetUnavailable, Scene
from mereo.scenes.statistical_model import StatisticalModel

Source = Any
"""An ``Object``, or what it is loaded from: a scene, weights, files, or meshes in memory."""

OPTIONS = ("scene", "weights", *names_of(MeshesConfig), *names_of(InferenceConfig))
"""Options of ``load_object``."""


@dataclass(frozen=True, eq=False, repr=False)
class Object:
    """Object that can be found in frames.

    Attributes:
        network: its weights; None of an object without, which is searched.
        scene: how it deforms, where that is not the built-in scene that the weights were trained on.
        model: statistical model of its states; by default that of the weights, None where these carry none.
        known_as: its name, where neither weights nor a scene have it.
        knows_joints: whether it is of ``with_joints``.
    """

    network: Trained | None
    scene: Scene | None = None
    _registrars: dict[str, Registrar | None] = field(default_factory=dict)
    model: StatisticalModel | None = None
    known_as: str = ""
    knows_joints: bool = False
    _narrowed: "dict[tuple[Range, ...], Object]" = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.network, Trained | None) or (self.network is None and self.model is None):
            raise ValueError(
                f"the network of an object is {value_text(self.network)}; it must be loaded weights, or None with a "
                "statistical model: use load_object"
            )
        if self.network is not None and self.model is None:
            object.__setattr__(self, "model", self.network.statistical_model)

    def __repr__(self) -> str:
        return f"Object({self.name!r}: {', '.join(self.names)})"

    @property
    def name(self) -> str:
        """Name of its weights, or of its scene."""
        if self.network is not None:
            return self.network.name
        return self.known_as if self.scene is None else self.scene.name

    @property
    def names(self) -> Names:
        """Names of the segments, in the order of their labels."""
        return self.segments.names

    @property
    def joints(self) -> Names:
        """Names of its joints, whose values results have, and ``with_joints`` takes."""
        return tuple(getattr(self.scene and self.scene.sample_deformations, "joints", ()))

    @property
    def segments(self) -> "Trained | SegmentedMesh":
        """What has their names, colours and nesting."""
        if self.network is not None:
            return self.network
        assert self.model is not None
        return self.model.rest

    def registrar(self, method: AnswerMethod = "auto", frame_joints: object = None) -> Registrar | None:
        """Registrar of the object's deformation model for a method, set up once; None where the network alone answers.

        Raises ``ValueError`` for a method that there is none of, where it cannot be had of this object, and where the
        network alone answers though values of joints are known, before all frames or, as ``frame_joints``, with each.
        """
        check_value("method", method, AnswerMethod, "auto")
        if method == "network" and self.network is None:
            raise ValueError(
                "the method is network, but the object has no weights: name them with --weights, or leave it out"
            )
        if method not in self._registrars and self.network is not None:
            self._registrars[method] = registrar_for(self.network, method, self.scene)
        elif method not in self._registrars:
            assert self.model is not None
            self._registrars[method] = Registrar(None, self.model, method, self.scene)
        registrar = self._registrars[method]
        if registrar is None and (self.knows_joints or frame_joints):
            raise ValueError(
                "values of joints are given, but the method is network, and a network alone takes none: leave them "
                "out, or take another method"
            )
        return registrar

    @python_words()
    def with_joints(self, joints: object) -> "Object":
        """The same with joints whose values are known: only the others are looked for.

        ``joints`` are those of ``reconstruct``, which makes the same of them. The statistical model of the states that
        are left is made in seconds, at once where all values are known; that of the last values is kept. Raises
        ``FileNotFoundError`` and ``ValueError`` for what gives no values of its joints.
        """
        scene = with_joints(self.scene, joints)
        motion = scene.sample_deformations
        assert isinstance(motion, RandomMotion)
        key = tuple(joint.shares for joint, _ in motion.joints.values())
        if key not in self._narrowed:
            self._narrowed.clear()
            with stage("make the statistical model of the states that the given joints leave"):
                model = narrowed_model(scene, self.model or kept_model(scene))
            known: Any = self.network and replace(self.network, statistical_model=model)  # type: ignore[type-var]
            self._narrowed[key] = Object(known, scene, {}, model, self.known_as, knows_joints=True)
        return self._narrowed[key]

    def asking(self, network: Trained | None) -> "Object":
        """The same with the same weights on another device; registrars that are set up stay so."""
        moved = {
            method: None if registrar is None else registrar.asking(network)
            for method, registrar in self._registrars.items()
        }
        return replace(self, network=network, _registrars=moved, _narrowed={})


class WithoutWeightsWarning(UserWarning):
    """Warning that a built-in object is searched by its model, as its weights or PyTorch are not installed."""


@python_words()
def load_object(
    source: Source = None,
    scene: Scene | str | Path | None = None,
    *,
    weights: Trained | str | Path | None = None,
    units: LengthUnit | None = None,
    deformations: Way = "auto",
    robot_meshes: RobotMeshes = "visual",
    **inference: Any,
) -> Object:
    """Load an object that can be found in frames.

    Args:
        source: its meshes, one file for each segment, one file of named parts, a robot's URDF, SDF or MJCF file, a
            folder of any of these, or label volumes, one or one for each segment; meshes in memory, of trimesh,
            Open3D, PyVista or (vertices, faces), as a dict by the segments' names or a list; a scene file, a built-in
            scene's name or a scene; the folder that ``mereo learn`` has written; or weights: a shipped name, a file,
            or some that are loaded already. A name that both weights and a scene have means the weights, which know
            that scene; without the extra `network` the object is searched by the model that they carry, with a
            ``WithoutWeightsWarning``, or by that of its scene where they are not installed.
        scene: of weights: the object's scene, its name or its file, where it is not the built-in one of the weights.
        weights: to start the fit with, where ``source`` is meshes or a scene, or none of them.
        units: of meshes: "mm", "cm", "m" or "in"; guessed where not given.
        deformations: how an object of meshes moves, as in ``mereo scene new``: "rigid", "soft" or "stiff" (as an
            elastic solid), or "articulated" (by the joints that its contacts suggest); "auto" is articulated where it
            has such joints, else soft.
        robot_meshes: which meshes of a robot's file stand for its links, "visual" or "collision"; a link without them
            has the others.
        inference: ``device``, where a network computes; "auto" takes a CUDA device where there is one; and
            ``precision`` of its products; "float32" is exact.

    Objects without weights get a statistical model of their scene's random states, in seconds, which is kept in the
    user's cache for the next time. Raises ``FileNotFoundError`` where there is no such file or name, ``ValueError`` for
    other files and for meshes without volume, ``ImportError`` for weights without the extra `network`, and
    ``TypeError`` for an option that there is none of.
    """
    check_names(inference, OPTIONS)
    meshes = MeshesConfig(units, deformations, robot_meshes)
    computing = InferenceConfig(**inference)
    network = weights if source is None else source
    if isinstance(network, Trained) or (isinstance(network, AnyPath) and (source is None or is_weights(network))):
        if source is not None and weights is not None:
            raise ValueError(f"{source} has weights, and weights are named too: name one of them")
        _check_meshless(network.name if isinstance(network, Trained) else network, meshes)
        if scene is None and str(source) in SCENES and not has_network():
            return _built_in_by_model(str(source))
        scene = _learned_scene(network) if scene is None else scene
        if not isinstance(scene, Scene | None):
            scene = load_scene(str(checked_path(scene, "scene")))
        return Object(load_weights(network, computing), scene)
    if weights is not None and not isinstance(weights, Trained):
        checked_path(weights, "weights")
    if source is None:
        raise ValueError("no object is given; name its meshes, its scene or its weights")
    if scene is not None:
        raise ValueError(f"{source} is no weights and has its own scene, but another one is named: leave it out")
    loaded = None if weights is None else load_weights(weights, computing)  # first, for a scene may take long
    scene = _scene(source, meshes)
    if loaded is None:
        return Object(None, scene, model=kept_model(scene))
    if loaded.statistical_model is not None and (fault := other_mesh(scene, loaded.statistical_model)):
        raise ValueError(f"{fault}; both must be of one object: name the weights of this one, or leave them out")
    return Object(loaded, scene)


def load_weights(given: Trained | AnyPath, inference: InferenceConfig) -> Trained:
    """Weights by their name or file, on the device and in the precision that are asked for; loaded ones as they are.

    Raises as ``models.weights.load_model`` does, and ``ImportError`` without the extra `network`.
    """
    if isinstance(given, Trained):
        return given
    with network_needed():
        from mereo.models.weights import load_for
    return load_for(given, inference)


def _built_in_by_model(name: str) -> Object:
    """Built-in object without its weights' network, by the statistical model that they carry."""
    warnings.warn(
        f"the extra `network` is not installed, so {name} is searched by its model: pip install 'mereo[network]' lets "
        "its weights start the fit at once",
        WithoutWeightsWarning,
        stacklevel=4,
    )
    scene = None
    with suppress(AssetUnavailable):  # the model has all that a search needs
        scene = load_scene(name)
    return Object(None, scene, model=statistical_model_in(name), known_as=name)


def object_of(given: Source, joints: object = None, **options: Any) -> Object:
    """Object of whatever a caller has of it, with known ``joints``; ``options`` are those of ``load_object``."""
    if options and isinstance(given, Object):
        raise ValueError(f"{min(options)} is given for an object that is loaded already: give it to load_object")
    known = given if isinstance(given, Object) else load_object(given, **options)
    return known if joints is None else known.with_joints(joints)


def _learned_scene(weights: Trained | AnyPath) -> str | None:
    """Scene of the folder of weights that ``mereo learn`` has written, as far as its file is still there."""
    scene = None if isinstance(weights, Trained) else scene_of_folder(Path(weights))
    return scene if scene is not None and (scene in SCENES or Path(scene).is_file()) else None


def _check_meshless(source: object, meshes: MeshesConfig) -> None:
    """Raise ``ValueError`` for what is stated of meshes, where the object is of none."""
    for what, value in vars(meshes).items():
        if value != getattr(MeshesConfig, what):
            raise ValueError(
                f"the {what.replace('_', ' ')} are {value}, but {source or 'the object'} says its own: leave them out"
            )


def _scene_in_memory(mesh: SegmentedMesh, meshes: MeshesConfig) -> Scene:
    """Scene of a mesh that no file has; sentences about it name one, object.obj, or that of its one segment."""
    with TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        name = mesh.names[0].replace("/", "-") if len(mesh.names) == 1 else "object"
        path = Path(folder) / f"{name}.obj"
        write_segments_obj(path, mesh)
        try:
            scene = scene_of_meshes([path], **vars(meshes))
        except ValueError as error:
            raise ValueError(str(error).replace(str(path), path.name)) from None
    for warning in caught:
        warnings.warn(str(warning.message).replace(str(path), path.name), warning.category, stacklevel=5)
    return scene


def _scene(source: Source, meshes: MeshesConfig) -> Scene:
    """Scene of what has no weights."""
    if isinstance(source, Scene):
        _check_meshless(source.name, meshes)
        return source
    assert not isinstance(source, Trained)
    if (mesh := mesh_of(source)) is not None:
        return _scene_in_memory(mesh, meshes)
    given = [source] if isinstance(source, AnyPath) else source
    if not isinstance(given, Sequence) or not all(isinstance(file, AnyPath) and str(file) for file in given):
        raise ValueError(
            f"the object is {value_text(source)}; it must be the path of a file or folder, a list of such paths, the "
            "name of a scene, a scene, or meshes with vertices and faces: name its meshes"
        )
    files = [Path(str(file)) for file in given]
    if len(files) == 1 and files[0].is_dir():
        folder = files[0]
        learned = scene_of_folder(files[0])
        files = [Path(learned)] if learned is not None else shapes_in(folder)
        if not files:
            raise ValueError(
                f"{folder} holds no meshes ({', '.join(sorted(MESH_SUFFIXES))}), no label volume, no {SCENE} and no "
                "weights: name the folder of an object, or its files"
            )
    if not files:
        raise ValueError("no object is given; name its meshes, one file for each segment, or its scene file")
    if names_scene(files):
        _check_meshless(files[0], meshes)
        return load_scene(files[0] if files[0].suffix else str(files[0]))
    if len(files) == 1 and files[0].suffix == "" and not files[0].exists():
        raise FileNotFoundError(
            f"there is no object {str(files[0])!r}: name its meshes, its scene file, a folder of mereo learn, a "
            f"built-in scene ({', '.join(SCENES)}), or weights (a name of mereo weights list, or a .safetensors file)"
        )
    return scene_of_meshes(files, **vars(meshes))
