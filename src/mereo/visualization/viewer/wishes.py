"""What hands ask of the laboratory's sliders and buttons, and the shapes that come of it, with the way back.

Hands only leave wishes, at any time and in any thread; one thread fulfils them, the latest of each kind.
"""

import threading
from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

import numpy as np

from mereo.scenes.parameters import Parameter, Refused
from mereo.visualization.viewer.freedom import Freedom

Shape = TypeVar("Shape")

HISTORY = 60
"""Changes that ``back`` remembers."""

STEPS = 48
"""Steps of a walk."""


class Wishes(Generic[Shape]):
    """Wishes for the shape that is shown, from the first one on.

    Attributes:
        shape: what the last wish has led to; None before the first call of ``fulfil``.
    """

    def __init__(self, freedom: Freedom[Shape], seed: int = 0) -> None:
        self.freedom = freedom
        self.shape: Shape | None = None
        self._lock = threading.Lock()
        self._first_seed, self._seeds = seed, np.random.default_rng(seed)
        self._moves: dict[tuple[Any, int | None], tuple[Parameter, float]] = {}
        self._leap: Callable[[Shape], Shape] | None = None
        self._path: Iterator[Shape] | None = None
        self._back = False
        self._past: list[Shape] = []
        self._hand: frozenset[Any] = frozenset()

    # --- hands --------------------------------------------------------------------------------------------------------

    def move(self, parameter: Parameter, value: float) -> None:
        """One slider elsewhere; wishes for different sliders are all kept."""
        with self._lock:
            self._moves[parameter.key, parameter.index] = (parameter, value)
            self._path = None

    def anew(self) -> None:
        """A random shape."""
        seed = self._seed()
        self._jump(lambda _: self.freedom.random(seed))

    def rest(self) -> None:
        """The object at rest."""
        self._jump(self.freedom.rest)

    def take(self, text: str) -> None:
        """The shape that a text says; raises ``ValueError`` as ``Freedom.read`` does."""
        shape = self.freedom.read(text)
        self._jump(lambda _: shape)

    def walk(self) -> None:
        """A smooth walk of ``STEPS`` steps, one for each call of ``fulfil``; any other wish ends it."""
        seed = self._seed()
        self._jump(lambda shape: self._set_out(shape, seed))

    def back(self) -> None:
        """The shape before the last change: all that one slider did until another hand moved, or a whole walk."""
        with self._lock:
            self._moves, self._leap, self._path, self._back = {}, None, None, True

    def _seed(self) -> int:
        with self._lock:
            return int(self._seeds.integers(2**31))

    def _jump(self, leap: Callable[[Shape], Shape]) -> None:
        with self._lock:
            self._moves, self._leap, self._path = {}, leap, None

    def _set_out(self, shape: Shape, seed: int) -> Shape:
        with self._lock:
            if not (self._moves or self._leap or self._back):  # no hand has moved meanwhile
                self._path = self.freedom.walk(shape, seed, STEPS)
        return shape

    # --- the thread that fulfils them ---------------------------------------------------------------------------------

    @property
    def is_walking(self) -> bool:
        """Whether the next call of ``fulfil`` takes another step of a walk."""
        return self._path is not None

    @property
    def can_go_back(self) -> bool:
        """Whether there is a change that ``back`` would undo."""
        return bool(self._past)

    def fulfil(self) -> Refused | None:
        """Lead to the shape that is wished for. Values that are refused are left out, and the last of them is told."""
        with self._lock:
            moves, leap, back, path = list(self._moves.values()), self._leap, self._back, self._path
            hand = frozenset(self._moves)
            self._moves, self._leap, self._back = {}, None, False
        if self.shape is None:
            self.shape = self.freedom.first(self._first_seed)
        if back and self._past:
            *self._past, self.shape = self._past
            self._hand = frozenset()
        elif leap is not None:
            self._remember(frozenset())
            self.shape = leap(self.shape)
        elif moves:
            return self._move(moves, hand)
        elif path is not None:
            self._step(path)
        return None

    def _move(self, moves: list[tuple[Parameter, float]], hand: frozenset[Any]) -> Refused | None:
        assert self.shape is not None
        shape, refusal = self.shape, None
        for parameter, value in moves:
            try:
                shape = self.freedom.moved(shape, parameter, value)
            except Refused as error:
                refusal = error
        if shape is not self.shape:
            self._remember(hand)
        self.shape = shape
        return refusal

    def _step(self, path: Iterator[Shape]) -> None:
        shape = next(path, None)
        if shape is not None:
            self.shape = shape
            return
        with self._lock:
            if self._path is path:  # no other wish has ended it
                self._path = None

    def _remember(self, hand: frozenset[Any]) -> None:
        """Keep the shape that is about to change; what one slider does until another hand moves is one change."""
        if self.shape is not None and (hand != self._hand or not hand):
            self._past = [*self._past, self.shape][-HISTORY:]
        self._hand = hand
