"""The degrees of freedom of a scene, found by recording what it draws.

A scene says how it deforms by drawing from a generator. ``Recorder`` is a generator that writes down every draw as
*shares*: where each number lies in its distribution, uniform in 0..1. Played back with other shares, the same scene
gives the state that lies there, within its own bounds. docs/design/0013-viewer.md says how draws are distinguished and
what happens in loops that draw again.
"""

import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from types import CodeType, FrameType
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import default_rng
from scipy.special import ndtri

from mereo.deformation.draw_names import DrawName, NamedGenerator
from mereo.geometry.conventions import WholeNumbers

Trail = tuple[tuple[CodeType, int], ...]
"""The calls that led to a draw, outermost first: code, and the instruction within it."""

Place = tuple[tuple[tuple[str, int, int], ...], DrawName]
"""Where a draw comes from: its trail, and what the scene calls it."""

Key = tuple[Place, int]
"""Which draw it is: its place, and how many draws there were from the same place before it."""

Shares = Float[ndarray, " n"]

SMOOTH = ("uniform", "normal", "triangular")
"""Kinds of draws between whose values there is a way: they move the state continuously. The others stay as they are."""

SMALLEST_SHARE = 1e-9
"""Keeps normal draws finite."""


class OutOfDraws(Exception):
    """Error of a scene that draws more than allowed: it refuses what it is given and draws again."""


@dataclass(frozen=True, eq=False)
class Call:
    """One call of the generator, as it was recorded.

    Attributes:
        key, trail: where it came from.
        name: what the scene calls it.
        kind: the method's name.
        shares: of each number, in C order.
        low, high: bounds of each number: of "uniform" and "integers" (high excluded) as drawn, of "normal" in standard
            deviations (infinite), of "choice" the positions in what is chosen from.
        shape: of the result; () for a single number.
        ends: of "choice", the share at which each option ends; options need not be equally likely.
    """

    key: Key
    trail: Trail
    name: DrawName
    kind: str
    shares: Shares
    low: Shares
    high: Shares
    shape: WholeNumbers
    ends: Float[ndarray, " o"] | None = None


class Recorder(NamedGenerator):
    """Generator that records its draws, and takes those that it is given.

    Methods that are not here (``gamma``, ``spawn``, ...), choices without replacement and draws into an array that is
    given work, and depend on the seed alone; they get no slider.
    """

    def __init__(self, seed: int, given: Mapping[Key, Shares], most: int | None = None) -> None:
        """Recorder of one run; ``most`` is the largest number of calls before ``OutOfDraws``."""
        super().__init__(np.random.PCG64([seed, 1]))
        self.calls = list[Call]()
        self._given, self._most = given, most
        self._fresh = default_rng([seed, 0])
        self._seen = Counter[Place]()
        self._ends: Any = None

    def __reduce__(self) -> Any:
        raise TypeError("a Recorder belongs to one run of a scene and cannot be copied")

    def _take(self, kind: str, shape: WholeNumbers, low: Any, high: Any) -> Shares:
        if self._most is not None and len(self.calls) >= self._most:
            raise OutOfDraws
        trail = _trail()
        name = self.take_name()
        steps = tuple((code.co_filename, code.co_firstlineno, instruction) for code, instruction in trail)
        place = (steps, name)
        key = (place, self._seen[place])
        self._seen[place] += 1
        size = int(np.prod(shape))
        shares = np.clip(self._chosen(key, size), SMALLEST_SHARE, 1 - SMALLEST_SHARE)
        bounds = [np.broadcast_to(np.asarray(bound, float), shape).ravel() for bound in (low, high)]
        self.calls.append(Call(key, trail, name, kind, shares, bounds[0], bounds[1], shape, self._ends))
        self._ends = None
        return shares

    def _chosen(self, key: Key, size: int) -> Shares:
        """Shares of a draw: those that are given for it, where they are as many, else fresh ones."""
        shares = self._given.get(key)
        return self._fresh.random(size) if shares is None or len(shares) != size else shares

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        """Uniform numbers between two bounds, which may be given in either order; recorded."""
        shape = _shape(size, low, high)
        # numpy takes the bounds in either order; a share counts from the lower one, as a slider does
        low, high = np.minimum(low, high), np.maximum(low, high)
        shares = self._take("uniform", shape, low, high).reshape(shape)
        return _plain(np.asarray(low, float) + shares * (np.asarray(high, float) - low))

    def random(self, size: Any = None, dtype: Any = np.float64, out: Any = None) -> Any:
        """Uniform numbers in 0..1; recorded, unless they are drawn into ``out``."""
        if out is not None:
            return super().random(size, dtype, out)
        return _plain(np.asarray(self.uniform(size=size), dtype))

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        """Normal numbers of mean ``loc`` and standard deviation ``scale``; recorded."""
        shape = _shape(size, loc, scale)
        return _plain(loc + scale * ndtri(self._take("normal", shape, -inf, inf)).reshape(shape))

    def standard_normal(self, size: Any = None, dtype: Any = np.float64, out: Any = None) -> Any:
        """Standard normal numbers; recorded, unless they are drawn into ``out``."""
        if out is not None:
            return super().standard_normal(size, dtype, out)
        return _plain(np.asarray(self.normal(size=size), dtype))

    def triangular(self, left: Any, mode: Any, right: Any, size: Any = None) -> Any:
        """Numbers of the triangular distribution; recorded."""
        shape = _shape(size, left, mode, right)
        shares = self._take("triangular", shape, left, right).reshape(shape)
        left, mode, right = (np.asarray(value, float) for value in (left, mode, right))
        rising = left + np.sqrt(shares * (right - left) * (mode - left))
        falling = right - np.sqrt((1 - shares) * (right - left) * (right - mode))
        return _plain(np.where(shares * (right - left) < mode - left, rising, falling))

    def integers(
        self, low: Any, high: Any = None, size: Any = None, dtype: Any = np.int64, endpoint: bool = False
    ) -> Any:
        """Whole numbers from ``low`` to below ``high``; recorded."""
        low, high = (0, low) if high is None else (low, high)
        high = np.asarray(high) + endpoint
        shape = _shape(size, low, high)
        shares = self._take("integers", shape, low, high).reshape(shape)
        return _plain((low + np.floor(shares * (high - low))).astype(dtype))

    def choice(
        self, a: Any, size: Any = None, replace: bool = True, p: Any = None, axis: int = 0, shuffle: bool = True
    ) -> Any:
        """Random elements of ``a``; recorded, unless they are drawn without replacement."""
        if not replace and size is not None:
            return super().choice(a, size, replace, p, axis, shuffle)
        options = _options(a)
        count = options.shape[axis]
        shape = _shape(size)
        self._ends = ends = np.cumsum(np.full(count, 1 / count) if p is None else p)
        shares = self._take("choice", shape, 0, count).reshape(shape)
        index = np.minimum(np.searchsorted(ends, shares, side="right"), count - 1)
        return _plain(np.take(options, index, axis=axis))

    def permutation(self, x: Any, axis: int = 0) -> Any:
        """The elements of ``x`` in random order; recorded as sort keys."""
        items = _options(x)
        order = np.argsort(self._take("permutation", (items.shape[axis],), 0.0, 1.0), kind="stable")
        return np.take(items, order, axis=axis)


def _shape(size: Any, *parameters: Any) -> WholeNumbers:
    if size is None:
        return np.broadcast_shapes(*(np.shape(p) for p in parameters))
    return (int(size),) if np.ndim(size) == 0 else tuple(int(n) for n in size)


def _options(given: Any) -> ndarray:
    """What numpy's generators choose from: an array, or the numbers below one."""
    return np.arange(given) if np.ndim(given) == 0 else np.asarray(given)


def _plain(values: Any) -> Any:
    """A single number as numpy's generators return it."""
    return values if np.ndim(values) else np.asarray(values)[()].item()


def _trail() -> Trail:
    """The calls from ``parameters.play`` down to the recorder, which are what a draw is known by.

    Without the recorder's own steps, and those of the tests' shape checks around every function.
    """
    frame: FrameType | None = sys._getframe(1)
    trail = list[tuple[CodeType, int]]()
    while frame is not None and frame.f_code.co_name != "play":
        code, file = frame.f_code, frame.f_code.co_filename
        if file != __file__ and not file.startswith("<@") and "jaxtyping" not in file:
            trail.append((code, frame.f_lasti))
        frame = frame.f_back
    return tuple(trail[::-1])
