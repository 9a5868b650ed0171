"""Names by which clients know weights: their own, their folder's, or what the operator says."""

import re
from collections.abc import Sequence
from pathlib import Path

from mereo_serving.messages import Served

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def served_objects(
    weights: Sequence[str], scenes: Sequence[str] = (), objects: Sequence[str] = ()
) -> tuple[Served, ...]:
    """Weights of ``bunny``, ``learned/weights.safetensors`` or ``liver=learned/weights.safetensors``, with scenes.

    Objects without weights are ``scene.yaml``, ``part.stl,other.stl`` or ``liver=part.stl,other.stl``. Without a name a
    file is called by its own, and one that is called weights by its folder; meshes are called by the first.

    Raises ``ValueError`` for none, for a name that is no part of an address, for two of one name, and for a scene to
    which there are no weights.
    """
    if not weights and not objects:
        raise ValueError(
            "no object is given; name what is to be served: mereo serve --object part.stl, or --weights bunny"
        )
    named, bare = [_named(text) for text in weights], [_named(text) for text in objects]
    played = dict(_pair(text) for text in scenes)
    names = [name for name, _ in (*named, *bare)]
    for name in names:
        if not NAME.fullmatch(name):
            raise ValueError(
                f"{name!r} cannot be a part of an address; names are letters, digits, '.', '_' and '-': give one, as "
                "in --weights liver=FILE"
            )
        if names.count(name) > 1:
            raise ValueError(f"two objects are called {name!r}; clients must tell them apart: --weights NAME=FILE")
    if lost := sorted(set(played) - set(names)):
        raise ValueError(f"--scene is for {lost[0]!r}, which is not served; there are {', '.join(names)}: name one")
    of_weights = [Served(name, file, played.get(name)) for name, file in named]
    return (*of_weights, *(Served(name, object=tuple(_files(text))) for name, text in bare))


def _files(text: str) -> list[str]:
    """Files that are joined by commas; one whose name has commas is itself."""
    return [text] if Path(text).exists() else text.split(",")


def _named(text: str) -> tuple[str, str]:
    if "=" in text and not Path(text).exists():
        return _pair(text)
    path = Path(text if Path(text).exists() else text.partition(",")[0])
    if path.suffix == "":
        return path.name, text
    return (path.absolute().parent.name if path.stem == "weights" else path.stem), text


def _pair(text: str) -> tuple[str, str]:
    name, equals, file = text.partition("=")
    if not (name and equals and file):
        raise ValueError(f"{text!r} is no NAME=FILE; say which weights it is for: give for example liver=scene.yaml")
    return name, file
