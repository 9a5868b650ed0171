"""Arrays that many share and nobody may change."""

from typing import TypeVar

import numpy as np

Array = TypeVar("Array", bound=np.ndarray)


def read_only(array: Array) -> Array:
    """Array itself, which raises ``ValueError`` from here on where somebody writes into it."""
    array.setflags(write=False)
    return array


def read_only_view(array: Array) -> Array:
    """View of the array through which nobody can write; whoever made the array still may."""
    return read_only(array.view())
