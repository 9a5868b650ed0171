"""Copies of a storage's objects in a local folder, by the SHA-256 of their content: read again, they are not fetched.

The folder is what ``MEREO_DATASET_CACHE`` says; without it nothing is copied. A copy is known by its content alone, so
it is never out of date, whatever becomes of the object, and one that is damaged is fetched again. Nothing here deletes
copies: the folder is its user's, who may delete it at any time.
"""

import os
from pathlib import Path

from mereo.io.object_storage import ObjectPath
from mereo.io.places import sha256, write_whole

CACHE_VARIABLE = "MEREO_DATASET_CACHE"


def read_cached(path: ObjectPath, recorded: str) -> bytes:
    """Content of an object whose SHA-256 is known; what has another one is no copy, and is not kept.

    Raises as ``ObjectPath.read_bytes`` does, and ``OSError`` where the folder cannot be written to.
    """
    folder = os.environ.get(CACHE_VARIABLE)
    if not folder:
        return path.read_bytes()
    copy = Path(folder) / recorded[:2] / recorded
    if copy.is_file() and sha256(content := copy.read_bytes()) == recorded:
        return content
    content = path.read_bytes()
    if sha256(content) == recorded:
        write_whole(copy, content)
    return content
