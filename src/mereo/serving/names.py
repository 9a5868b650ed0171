"""Names by which clients know weights: their own, their folder's, or what the operator says."""

import re
from collections.abc import Sequence
from pathlib import Path

from mereo.serving.messages import Served

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def served_weights(weights: Sequence[str], scenes: Sequence[str] = ()) -> tuple[Served, ...]:
    """Weights of ``bunny``, ``learned/weights.safetensors`` or ``liver=learned/weights.safetensors``, with scenes.

    Without a name a file is called by its own, and one that is called weights by its folder.

    Raises ``ValueError`` for none, for a name that is no part of an address, for two of one name, and for a scene to
    which there are no weights.
    """
    if not weights:
        raise ValueError("no weights are given; name what is to be served: mereo serve --weights bunny")
    named = [_named(text) for text in weights]
    played = dict(_pair(text) for text in scenes)
    names = [name for name, _ in named]
    for name in names:
        if not NAME.fullmatch(name):
            raise ValueError(
                f"{name!r} cannot be a part of an address; names are letters, digits, '.', '_' and '-': give one, as "
                "in --weights liver=FILE"
            )
        if names.count(name) > 1:
            raise ValueError(f"two weights are called {name!r}; clients must tell them apart: --weights NAME=FILE")
    if lost := sorted(set(played) - set(names)):
        raise ValueError(f"--scene is for {lost[0]!r}, which is not served; there are {', '.join(names)}: name one")
    return tuple(Served(name, file, played.get(name)) for name, file in named)


def _named(text: str) -> tuple[str, str]:
    if "=" in text and not Path(text).exists():
        return _pair(text)
    path = Path(text)
    if path.suffix == "":
        return path.name, text
    return (path.absolute().parent.name if path.stem == "weights" else path.stem), text


def _pair(text: str) -> tuple[str, str]:
    name, equals, file = text.partition("=")
    if not (name and equals and file):
        raise ValueError(f"{text!r} is no NAME=FILE; say which weights it is for: give for example liver=scene.yaml")
    return name, file
