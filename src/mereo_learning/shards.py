"""Datasets: shards of 64 examples, each written whole or not at all, the same bits for any number of workers.

Example i comes from (seed, i) alone. A dataset is a directory, or one in a storage (``io.object_storage``), with
``manifest.json``, everything needed to make it again, and ``shard-00000.safetensors`` and so on, whose tensors are (e
examples, p stored points, q queries):

    cloud f32 [e, p, 3], cloud_count i32 [e], center f64 [e, 3], scale f64 [e],
    positions f32 [e, q, 3], labels u8 [e, q], distances f32 [e, q], directions f16 [e, q, 3], rest f16 [e, q, 3]

with further observations (``synthesis.examples``), of which each has k,

    seen f16 [e, k, p, 3], seen_count i32 [e, k]

and ``template.safetensors``, the segments at rest: distance f16 [segments, n, n, n] (``scenes.rest_pose``), and
``statistical_model.safetensors``, the modes of the object's random states (``scenes.statistical_model``).

Each file has a checksum of its bytes and the key of its dataset (``io.checked_tensors``). Generation reads both before
it keeps a file of an interrupted run, training before it learns from one.

Workers only compute; this process alone writes. So one place meets a full disk, and whatever kills a worker leaves
nothing half-written.
"""

import hashlib
import json
import platform
import re
import shutil
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float, Float16
from pydantic import BaseModel, Field, ValidationError

from mereo.geometry.transforms import Points
from mereo.io.atomic_files import check_place
from mereo.io.checked_tensors import check_tensors, pack_tensors, read_content, unpack_tensors
from mereo.io.errors import first_problem, reason
from mereo.io.object_storage import Place, claim, names_in, write_whole
from mereo.io.progress import progress
from mereo.scenes.random_states import scene_model, states_for
from mereo.scenes.registry import is_yaml, load_scene
from mereo.scenes.rest_pose import TEMPLATE_NODES, rest_digest, rest_distances
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.scenes.statistical_model import read_statistical_model, statistical_model_bytes
from mereo.synthesis.config import STATISTICAL_MODEL, TEMPLATE, GenerateConfig
from mereo.synthesis.examples import Example, synthesize
from mereo.workers.spread import Cluster, spread

SHARD_SIZE = 64
MANIFEST = "manifest.json"

LIBRARIES = ("numpy", "scipy", "libigl", "manifold3d", "trimesh")
"""Libraries whose versions are in the manifest: others may move last bits, but make no other dataset."""

NOT_COMPARED = ("libraries", "bytes")
"""Manifest entries that may differ when a dataset is resumed."""

DECISIVE = ("scene", "segments", "nested", "any_roll", "workspace", "settings", "seed", "rest_sha256")
"""Manifest entries that decide what example i is; a scene file's text, source and unit may change without."""

SHARD = {
    "cloud": "e p 3",
    "cloud_count": "e",
    "center": "e 3",
    "scale": "e",
    "positions": "e q 3",
    "labels": "e q",
    "distances": "e q",
    "directions": "e q 3",
    "rest": "e q 3",
}
"""Tensors of a shard by their axes: e examples, p stored points, q queries."""

OBSERVED = {"seen": "e k p 3", "seen_count": "e k"}
"""Tensors that a dataset with k further observations has besides."""


# --- files of a dataset -----------------------------------------------------------------------------------------------


class _Segment(BaseModel):
    """Segment in a manifest."""

    name: str
    color: tuple[int, int, int]


class _Sampling(BaseModel):
    """Settings of sampling that training reads."""

    per_segment: Annotated[int, Field(ge=0)]


class _Settings(BaseModel):
    """Settings that training reads."""

    sampling: _Sampling


class _Manifest(BaseModel):
    """Entries of a manifest that programs read; the others decide the dataset's key, or are for people."""

    scene: str
    seed: int
    examples: Annotated[int, Field(ge=1)]
    settings: _Settings
    segments: Annotated[tuple[_Segment, ...], Field(min_length=1, max_length=254)]
    nested: tuple[tuple[str, str], ...] = ()
    any_roll: bool
    version: str
    shard_size: Annotated[int, Field(ge=1)]
    unit_m: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    source: str | None = None


def read_manifest(directory: Place) -> dict[str, Any]:
    """Manifest of a dataset; ``FileNotFoundError`` or ``ValueError`` with one sentence on what is wrong otherwise."""
    path = directory / MANIFEST
    try:
        manifest: dict[str, Any] = json.loads(path.read_text("utf-8"))
        _Manifest.model_validate(manifest)
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        raise FileNotFoundError(
            f"{directory} has no {MANIFEST}; a dataset is a directory made by mereo generate"
        ) from None
    except ValidationError as error:
        raise ValueError(
            f"{path} is not the manifest of a dataset ({first_problem(error)}); generate the dataset again"
        ) from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not valid JSON ({reason(error)}); generate the dataset again") from None
    return manifest


def dataset_key(manifest: Mapping[str, Any]) -> str:
    """Digest of what decides a dataset's examples, by which its files know whose they are."""
    text = json.dumps({name: manifest.get(name) for name in DECISIVE}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def expected_files(manifest: Mapping[str, Any]) -> list[str]:
    """Names of the files that a dataset must have, but for its manifest."""
    # nothing is trained on a test set
    models = [] if manifest["seed"] >= TEST_SEED_START else [STATISTICAL_MODEL]
    return [TEMPLATE, *models, *shard_names(manifest)]


def check_file(path: Place, manifest: Mapping[str, Any]) -> None:
    """Read a file of the dataset with this manifest; raises as ``read_shard`` does."""
    if path.name == TEMPLATE:
        read_template(path, manifest)
    elif path.name == STATISTICAL_MODEL:
        read_statistical_model(read_content(path), dataset_key(manifest))
    else:
        read_shard(path, manifest)


def whole_files(folder: Place, manifest: Mapping[str, Any], files: Iterable[str]) -> set[str]:
    """Those of a dataset's files that are there and whole; damaged ones are reported."""
    whole = set[str]()
    for name in sorted({*names_in(folder)}.intersection(files)):
        try:
            check_file(folder / name, manifest)
            whole.add(name)
        except FileNotFoundError:
            pass
        except ValueError:
            print(f"{name} is damaged and is made again", flush=True)
    return whole


def check_dataset(folder: Place) -> None:
    """Read every file of a dataset and print each that is missing, wrong or too many, with the reason.

    Raises ``ValueError`` where a file is not good, or the folder holds no dataset, ``FileNotFoundError`` where there is
    none, and ``StorageError`` where the storage refuses.
    """
    manifest = read_manifest(folder)
    problems = dict[str, str]()
    files = expected_files(manifest)
    with progress("check", len(files), "files") as shown:
        for name in files:
            try:
                check_file(folder / name, manifest)
            except FileNotFoundError:
                problems[name] = "it is missing"
            except ValueError as error:
                problems[name] = str(error)
            shown.advance(1)
    spare = sorted(
        name for name in {*names_in(folder)}.difference(files) if re.fullmatch(r"shard-.*\.safetensors", name)
    )
    for name, why in problems.items():
        print(f"{name}: {why}")
    for name in spare:
        print(f"{name}: it is no part of this dataset, which ends before it")
    if problems:
        raise ValueError(
            f"{folder}: {len(problems)} of {len(files)} files are not good; the `mereo generate` command that made it, "
            "with --resume, makes just these again"
        )
    if spare:
        raise ValueError(
            f"{folder}: {len(spare)} files are not of this dataset; move {'them' if spare[1:] else 'it'} away"
        )
    print(f"{folder}: all {len(files)} files are whole, {manifest['examples']} examples")


def shard_name(number: int) -> str:
    """Name of a shard's file."""
    return f"shard-{number:05d}.safetensors"


def shard_names(manifest: Mapping[str, Any]) -> list[str]:
    """Names of the shards of a whole dataset, in the order of their examples."""
    return [shard_name(number) for number in range(-(-manifest["examples"] // manifest["shard_size"]))]


def read_shard(path: Place, manifest: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Tensors of a shard of the dataset with this manifest, named by ``shard_name``.

    Raises ``FileNotFoundError``, ``ValueError`` (its reason only) where it is damaged or another's, and
    ``StorageError`` where nothing is known of it.
    """
    tensors, facts = unpack_tensors(read_content(path), dataset_key(manifest))
    first = shard_names(manifest).index(path.name) * manifest["shard_size"]
    if facts.get("first") not in (None, first):
        raise ValueError(f"it begins with example {facts['first']} instead of {first}")
    shapes = SHARD | (OBSERVED if OBSERVED.keys() & tensors.keys() else {})
    check_tensors(tensors, shapes, {"e": min(manifest["shard_size"], manifest["examples"] - first)})
    return tensors


def read_template(path: Place, manifest: Mapping[str, Any]) -> Float16[np.ndarray, "s n n n"]:
    """Signed distances of the template of the dataset with this manifest; raises as ``read_shard`` does."""
    tensors, _ = unpack_tensors(read_content(path), dataset_key(manifest))
    check_tensors(tensors, {"distance": "s n n n"}, {"s": len(manifest["segments"]), "n": TEMPLATE_NODES})
    return tensors["distance"]


# --- generation -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DatasetConfig:
    """Which examples of a scene a dataset holds.

    Attributes:
        settings: how one example is made.
        examples: how many, in all shards together.
        seed: seeds from ``TEST_SEED_START`` up are for testing and need ``test``, which refuses smaller ones.
        test: whether it is a test set, whose seed training refuses.
    """

    settings: GenerateConfig
    examples: int
    seed: int
    test: bool = False

    def check(self) -> None:
        """Raise ``ValueError`` for a number out of its range, and for a seed of the wrong kind."""
        if self.examples < 1:
            raise ValueError(f"--examples is {self.examples}; it must be at least 1: ask for some")
        if self.seed < 0:
            raise ValueError(f"--seed is {self.seed}; it must not be negative: choose from 0 to {TEST_SEED_START - 1}")
        if self.seed >= TEST_SEED_START and not self.test:
            raise ValueError(
                f"--seed is {self.seed}; seeds from {TEST_SEED_START} up are for testing and never for training: "
                "choose a smaller one, or pass --test to make a test set"
            )
        if self.test and self.seed < TEST_SEED_START:
            raise ValueError(
                f"--seed is {self.seed}; a test set needs one from {TEST_SEED_START} up, which training never uses: "
                "choose one"
            )


def generate(
    scene: str | Scene,
    output: Place,
    config: DatasetConfig,
    *,
    workers: int | Cluster = 1,
    shard: tuple[int, int] = (0, 1),
    resume: bool = False,
) -> None:
    """Make labelled examples of a scene in the folder ``output``, local or of an object storage.

    Args:
        scene: a built-in scene's name, a scene file, or a scene (which workers must be able to unpickle).
        output: created; with ``resume`` its complete shards are kept and the missing ones made.
        config: which examples.
        workers: processes, or a cluster whose tasks make the files' content; they are written here all the same, and
            depend on neither. More than one process needs a main module that can be imported (``if __name__ ==
            "__main__":``).
        shard: ``(i, n)`` makes every n-th file from the i-th on, to share the work between machines; they may all
            write to one directory.
        resume: go on with a dataset of the same settings that is there; without it that is an error.

    Raises:
        ValueError: a number out of its range, a seed of the wrong kind, ``resume`` with other settings.
        FileExistsError: ``output`` holds something and ``resume`` is not set.
        OSError: the disk is full, or the storage refuses; complete shards are kept. ``ChildProcessError`` where a
            worker was killed.
        ImportError: the storage's library is missing.
    """
    if isinstance(output, Path):
        check_place(output, may_be_link=True)
    config.check()
    if isinstance(workers, int) and workers < 1:
        raise ValueError(f"the number of workers is {workers}; it must be at least 1: pass 1, or one per core")
    if not 0 <= shard[0] < shard[1]:
        raise ValueError(f"the shard is {shard[0]}/{shard[1]}; i/n needs i from 0 to n - 1: pass for example 0/4")
    settings, examples, seed = config.settings, config.examples, config.seed
    loaded = load_scene(scene) if isinstance(scene, str) else scene
    manifest = make_manifest(loaded, settings, examples, seed)
    if isinstance(output, Path):  # an object storage tells no free space
        stored = sum(file.stat().st_size for file in output.glob("shard-*.safetensors"))
        disk = next(folder for folder in output.absolute().parents if folder.is_dir())
        needed = manifest["bytes"] // shard[1] - stored
        free = shutil.disk_usage(disk).free
        if needed > free:
            raise ValueError(
                f"--examples {examples} needs {needed / 1e9:,.1f} GB and {output} has {free / 1e9:,.1f} GB free: ask "
                "for fewer, or change --output"
            )
    numbers = range(shard[0], -(-examples // SHARD_SIZE), shard[1])
    before = claim(output, MANIFEST, manifest, "a dataset")
    if before is not None:
        names = names_in(output)
        if not resume and (shard[1] == 1 or any(shard_name(number) in names for number in numbers)):
            raise FileExistsError(f"{output} holds a dataset; continue it with --resume, or choose another --output")
        _check_same(output, before, manifest)
        manifest = read_manifest(output)
    key = dataset_key(manifest)
    whole = whole_files(output, manifest, [TEMPLATE, STATISTICAL_MODEL, *map(shard_name, numbers)])
    if TEMPLATE not in whole:
        write_whole(output / TEMPLATE, pack_tensors({"distance": rest_distances(loaded.rest)}, {"dataset": key}))
    # nothing is trained on a test set
    if not config.test and STATISTICAL_MODEL not in whole:
        states = states_for(examples)
        print(f"modes of {states} random states, for registration", flush=True)
        write_whole(output / STATISTICAL_MODEL, statistical_model_bytes(scene_model(loaded, states, quiet=False), key))
    missing = [
        range(number * SHARD_SIZE, min(examples, (number + 1) * SHARD_SIZE))
        for number in numbers
        if shard_name(number) not in whole
    ]
    # what a YAML file says can be sent, and is then the same for all workers even if the file changes meanwhile; other
    # machines have neither file nor assets
    sent = loaded if isinstance(workers, Cluster) or is_yaml(scene) else scene
    work = partial(_make_shard, sent, settings, seed, key)
    with closing(spread(work, missing, workers)) as made, progress("generate", sum(map(len, missing))) as shown:
        for rows, data in made:
            write_whole(output / shard_name(rows.start // SHARD_SIZE), data)
            shown.advance(len(rows))


# --- the manifest -----------------------------------------------------------------------------------------------------


def make_manifest(scene: Scene, settings: GenerateConfig, examples: int, seed: int) -> dict[str, Any]:
    """Manifest of a dataset as JSON values: all that decides it, and what training needs to know of the scene."""
    workspace = scene.workspace_named(settings.workspace)
    manifest = {
        "scene": scene.name,
        "source": scene.source,
        "segments": [{"name": s.name, "color": s.color} for s in scene.rest.segments],
        "nested": scene.rest.nested,
        "any_roll": workspace.any_roll,
        "workspace": asdict(workspace),
        "settings": settings.stated(),
        "seed": seed,
        "examples": examples,
        "shard_size": SHARD_SIZE,
        "rest_sha256": rest_digest(scene.rest),
        "scene_file_sha256": hashlib.sha256(scene.definition.encode()).hexdigest() if scene.definition else None,
        "unit_m": scene.unit_m,
        "version": version("mereo"),
        "libraries": {"python": platform.python_version(), **{name: version(name) for name in LIBRARIES}},
        "bytes": examples * example_bytes(settings, len(scene.rest.segments)),
    }
    plain: dict[str, Any] = json.loads(json.dumps(manifest))
    return plain


def example_bytes(settings: GenerateConfig, segments: int) -> int:
    """Size of one example in bytes, on disk and in memory."""
    per_point = 12
    per_query = 12 + 1 + 4 + 6 + 6
    once = 4 + 24 + 8
    seen = len(settings.further) * (6 * settings.points + 4)
    return per_point * settings.points + per_query * settings.sampling.total(segments) + once + seen


def _check_same(output: Place, before: dict[str, Any], manifest: dict[str, Any]) -> None:
    default = {"settings.observations": [], "settings.workspace": "own"}  # manifests do not state these
    earlier = default | _flat(before)
    for key, now in (default | _flat(manifest)).items():
        if earlier.get(key) != now:
            raise ValueError(
                f"{output} was made with {key} = {earlier.get(key)!r}, not {now!r}; resuming needs equal settings: "
                "use them, or choose another --output"
            )


def _flat(value: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as ``settings.sampling.sampler`` and so on."""
    flat: dict[str, Any] = {}
    for key, item in value.items():
        if key not in NOT_COMPARED:
            flat |= _flat(item, f"{prefix}{key}.") if isinstance(item, dict) else {prefix + key: item}
    return flat


# --- the work ---------------------------------------------------------------------------------------------------------


def _make_shard(scene: str | Scene, settings: GenerateConfig, seed: int, dataset: str, rows: range) -> bytes:
    """Content of the file of these examples; a built-in scene goes by its name."""
    loaded = (load_scene(scene) if isinstance(scene, str) else scene).for_seed(seed)
    examples = [pack(synthesize(loaded, settings, example_rng(seed, row)), settings.points) for row in rows]
    tensors = {key: np.stack([example[key] for example in examples]) for key in examples[0]}
    return pack_tensors(tensors, {"dataset": dataset, "first": rows.start})


def pack(example: Example, points: int) -> dict[str, np.ndarray]:
    """Row of each tensor of a shard for one example; clouds with fewer points repeat theirs from the front."""
    count = len(example.cloud)
    queries = example.queries
    seen = dict[str, np.ndarray]()
    if example.observations:  # half precision is off by 0.0003 where a pixel is 0.03 wide
        clouds = np.stack([_filled(cloud, points) for cloud in example.observations]).astype(np.float16)
        counts = np.array([len(cloud) for cloud in example.observations], dtype=np.int32)
        seen = {"seen": clouds, "seen_count": counts}
    return {
        "cloud": _filled(example.cloud, points).astype(np.float32),
        "cloud_count": np.array(count, dtype=np.int32),
        "center": example.normalizer.center.astype(np.float64),
        "scale": np.array(example.normalizer.scale, dtype=np.float64),
        "positions": queries.positions.astype(np.float32),
        "labels": queries.labels.astype(np.uint8),
        "distances": queries.distances.astype(np.float32),
        "directions": queries.directions.astype(np.float16),
        "rest": queries.rest.astype(np.float16),
        **seen,
    }


def _filled(cloud: Points, points: int) -> Float[np.ndarray, "p 3"]:
    return cloud[np.arange(points) % len(cloud)]
