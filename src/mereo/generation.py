"""Many examples on disk: shards of 64, written whole or not at all, the same bits for any number of workers."""

import hashlib
import json
import multiprocessing
import os
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
from safetensors.numpy import save_file

from mereo.config import TEST_SEED_START, GenerateConfig
from mereo.output import write_json
from mereo.scene import Scene, load_scene
from mereo.synthesis import Example, example_rng, synthesize

SHARD = 64


def generate(
    scene_name: str,
    output: Path,
    settings: GenerateConfig,
    *,
    examples: int,
    seed: int,
    workers: int = 1,
    shard: tuple[int, int] = (0, 1),
    resume: bool = False,
    test: bool = False,
) -> None:
    if seed >= TEST_SEED_START and not test:
        raise ValueError(f"seed {seed} is for testing; training data needs a seed below {TEST_SEED_START}: choose one")
    scene = load_scene(scene_name)
    manifest = make_manifest(scene, settings, examples, seed)
    output.mkdir(parents=True, exist_ok=True)
    path = output / "manifest.json"
    if path.is_file() and not resume:
        raise FileExistsError(f"{output} exists; continue it with --resume, or choose another --output")
    write_json(path, manifest)
    jobs = [
        (scene_name, output, settings, seed, number, min(examples, (number + 1) * SHARD))
        for number in range(shard[0], -(-examples // SHARD), shard[1])
        if not (output / f"shard-{number:05d}.safetensors").is_file()
    ]
    start, done = time.monotonic(), 0
    with multiprocessing.get_context("fork").Pool(workers, _quiet) as pool:
        for count in pool.imap_unordered(_write_shard, jobs):
            done += count
            rate = done / (time.monotonic() - start)
            left = sum(j[5] - j[4] * SHARD for j in jobs) - done
            print(f"{done} examples  {rate:.1f}/s  {left / rate / 60:.1f} min left", flush=True)


def make_manifest(scene: Scene, settings: GenerateConfig, examples: int, seed: int) -> dict[str, object]:
    digest = hashlib.sha256()
    for segment in scene.rest.segments:
        digest.update(np.ascontiguousarray(segment.vertices, dtype=np.float64).tobytes())
        digest.update(np.ascontiguousarray(segment.faces, dtype=np.int64).tobytes())
    manifest: dict[str, object] = {
        "scene": scene.name,
        "segments": [{"name": s.name, "color": list(s.color)} for s in scene.rest.segments],
        "any_roll": scene.workspace.any_roll,
        "settings": asdict(settings),
        "seed": seed,
        "examples": examples,
        "version": "0.1.0",
        "rest_sha256": digest.hexdigest(),
    }
    return json.loads(json.dumps(manifest))


def _quiet() -> None:
    os.environ["OMP_NUM_THREADS"] = "1"


def _write_shard(job: tuple[str, Path, GenerateConfig, int, int, int]) -> int:
    scene_name, output, settings, seed, number, end = job
    scene = load_scene(scene_name)
    rows = [
        pack(synthesize(scene, settings, example_rng(seed, i)), settings.points) for i in range(number * SHARD, end)
    ]
    tensors = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
    path = output / f"shard-{number:05d}.safetensors"
    temporary = path.with_suffix(".tmp")
    try:
        save_file(tensors, temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return len(rows)


def pack(example: Example, points: int) -> dict[str, np.ndarray]:
    count = len(example.cloud)
    queries = example.queries
    return {
        "cloud": example.cloud[np.arange(points) % count].astype(np.float32),
        "cloud_count": np.array(count, dtype=np.int32),
        "center": example.normalizer.center.astype(np.float64),
        "scale": np.array(example.normalizer.scale, dtype=np.float64),
        "positions": queries.positions.astype(np.float32),
        "labels": queries.labels,
        "distances": queries.distances.astype(np.float32),
        "directions": queries.directions.astype(np.float16),
        "rest": queries.rest.astype(np.float16),
    }
