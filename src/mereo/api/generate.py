"""The first step from an object to weights, as a function: labelled examples, for which no torch is needed.

scene -generate-> dataset
"""

import os
from pathlib import Path
from typing import Any

from mereo.api.words import check_names, names_of, python_words
from mereo.io.object_storage import ObjectPath, Place, place_of
from mereo.scenes.scene import Scene
from mereo.synthesis.config import GenerateConfig
from mereo.workers.spread import choose_cluster
from mereo_learning import shards


def generate(
    scene: str | Path | Scene,
    output: str | Path | ObjectPath,
    settings: GenerateConfig | None = None,
    *,
    workers: int = 1,
    shard: tuple[int, int] = (0, 1),
    resume: bool = False,
    ray: str | None = None,
    **dataset: Any,
) -> Place:
    """Labelled examples of a scene in a folder, which is returned: `mereo generate`.

    Args:
        scene: a built-in scene's name, a scene file, or a scene.
        output: folder to create; a text may be its URL in an object storage, s3://BUCKET/FOLDER or gs://BUCKET/FOLDER.
        settings: how one example is made; ``SENSORS`` of ``mereo.synthesis.config`` has those of depth cameras.
        workers: processes, on which the examples do not depend; 0 means one per core. More than one needs a main module
            that can be imported (``if __name__ == "__main__":``).
        shard: part i of n, as (i, n), to share the work between machines.
        resume: go on with what is there.
        ray: make them in tasks of a Ray cluster: "local", one of so many workers for this call; "auto" or "HOST:PORT",
            the one that this machine is a node of.
        dataset: the other fields of ``DatasetConfig``: ``examples``, how many; ``seed``, by default 0: example i comes
            from (seed, i) alone, and seeds from 1,000,000 up are for testing; ``test=True``, to allow a test seed.

    Raises as ``mereo_learning.shards.generate`` does, and ``TypeError`` without ``examples``.
    """
    place = place_of(output)
    processes = workers or os.cpu_count() or 1
    check_names(dataset, names_of(shards.DatasetConfig))
    with python_words():
        shards.generate(
            str(scene) if isinstance(scene, Path) else scene,
            place,
            shards.DatasetConfig(settings or GenerateConfig(), **{"seed": 0, **dataset}),
            workers=choose_cluster(ray, processes) or processes,
            shard=shard,
            resume=resume,
        )
    return place
