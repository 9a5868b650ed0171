"""Names of the numbers that a scene draws, for people who move them by sliders.

    with part(rng, "left ear"):
        angle_rad = named(rng, "bend", "rad").uniform(0.0, 0.7)

Only a ``NamedGenerator`` keeps them, such as the laboratory's (``mereo.scenes.draw_recorder``). Any other generator
draws as without names, and names change no number with either.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from numpy.random import Generator

from mereo.geometry.conventions import Names


@dataclass(frozen=True)
class DrawName:
    """Name of what one call of a generator draws.

    Attributes:
        parts: the parts of the object that it belongs to, the outermost first; () is the whole object.
        name: of all its numbers, or of each of them in C order; "" where the scene did not say.
        unit: of the numbers as they are drawn; "rad" is shown in degrees, "log" is a factor's logarithm.
    """

    parts: Names = ()
    name: str | Names = ""
    unit: str = ""


class NamedGenerator(Generator):
    """Generator that knows the name of its next draw, and its parts, the outermost first.

    ``checked`` is whether states that the scene would refuse are to be refused, see ``unchecked``.
    """

    parts: Names = ()
    next_name: tuple[str | Names, str] = ("", "")
    checked: bool = True

    def take_name(self) -> DrawName:
        """Name of the draw that is being made; the one after it has none until it is named."""
        (name, unit), self.next_name = self.next_name, ("", "")
        return DrawName(self.parts, name, unit)


def named(rng: Generator, name: str | Names, unit: str = "") -> Generator:
    """Generator ``rng`` itself, with a name for the numbers of its next draw.

    ``name`` is that of all numbers, or of each of them in C order; ``unit`` as they are drawn is "rad", "°", "mm",
    "log" for a factor's logarithm, "" for shares.
    """
    if isinstance(rng, NamedGenerator):
        rng.next_name = (name, unit)
    return rng


def unchecked(rng: Generator) -> bool:
    """Whether a scene may leave out its test of a state, as the state itself is not wanted.

    A fit simulates states a small step from a tested one for what each draw moves. A test such as for parts that meet
    may take longer than the rest of a state, and refused neighbours would tell nothing.
    """
    return isinstance(rng, NamedGenerator) and not rng.checked


@contextmanager
def part(rng: Generator, name: str) -> Iterator[None]:
    """Block of code whose draws all belong to a part of the object, or to a part of the part around it."""
    if not isinstance(rng, NamedGenerator):
        yield
        return
    before = rng.parts
    rng.parts = (*before, name)
    try:
        yield
    finally:
        rng.parts = before
