"""Statistical model of an object without weights: made of its scene's random states in seconds, and kept for later.

Scene -kept_model-> StatisticalModel

The file's name is a digest of all that the model is made from: the rest mesh, the first random states, which change
with the scene and with the code that deforms it, and the constants. So a file is never out of date, and whoever wants
the space may delete it. The folder is ``models`` in the user's cache of mereo, or what ``MEREO_CACHE`` names.
"""

import hashlib
import os
from contextlib import suppress
from pathlib import Path

import numpy as np

from mereo.io.progress import stage
from mereo.scenes.random_states import NODES, STATES_SEED, scene_model
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng
from mereo.scenes.statistical_model import StatisticalModel
from mereo.scenes.statistical_model_file import read_statistical_model, save_statistical_model, statistical_model_bytes

CACHE_VARIABLE = "MEREO_CACHE"
"""Environment variable that names another folder than the user's cache."""

OBJECT_STATES = 400
"""States of an object that nothing is trained on: with more, the answers are the same and the wait is longer."""

KEYED_BY = 3
"""States that decide the name of the file."""

VERSION = 1
"""To be raised where the same states give another model."""


def kept_model(scene: Scene, count: int = OBJECT_STATES) -> StatisticalModel:
    """Statistical model of a scene: read where it was made before, else made, and kept where that can be written."""
    path = cache_folder() / "models" / f"{model_key(scene, count)}.safetensors"
    with suppress(OSError, ValueError):  # not there, or damaged: it is made anew
        return read_statistical_model(path.read_bytes(), None, None)
    with stage("make the object's statistical model, once"):
        made = scene_model(scene, count)
    with suppress(OSError):  # a full disk, or a home that cannot be written to: it is made again next time
        save_statistical_model(made, path)
    return read_statistical_model(statistical_model_bytes(made), None, None)  # the same bits as from the file


def cache_folder() -> Path:
    """Folder of what mereo keeps for later."""
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        return Path(named)
    import pooch

    return Path(pooch.os_cache("mereo"))


def model_key(scene: Scene, count: int) -> str:
    """Digest of all that a scene's model is made from."""
    drawn = scene.for_seed(STATES_SEED)
    digest = hashlib.sha256(f"{VERSION} {count} {STATES_SEED} {NODES} {scene.unit_m} {scene.rest.nested}".encode())
    digest.update(np.ascontiguousarray(scene.T_scene_source).tobytes())
    for segment in drawn.rest.segments:
        digest.update(f"{segment.name} {segment.color} {segment.solid} {segment.faces.shape}".encode())
        digest.update(np.ascontiguousarray(segment.faces, dtype=np.int64).tobytes())
    for mesh in (drawn.rest, *(drawn.sample_state(example_rng(STATES_SEED, i)).mesh for i in range(KEYED_BY))):
        digest.update(np.ascontiguousarray(mesh.merged()[0], dtype=np.float64).tobytes())
    return digest.hexdigest()[:32]
