"""States of a scene as points of a cube: every number that the scene draws is one degree of freedom.

    scene -play-> Played (its draws, its deformations) -parameters-> Parameter, ... -set_value-> another Played

See ``mereo.scenes.draw_recorder`` for how draws are recorded, and docs/design/0013-viewer.md.
"""

import linecache
import re
from collections import Counter
from collections.abc import Mapping, Sequence, Sized
from contextlib import suppress
from dataclasses import dataclass, replace
from math import pi
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import default_rng
from scipy.special import ndtr, ndtri

from mereo.deformation.maps import Deformations
from mereo.deformation.samplers import JointSampler, RandomMotion
from mereo.geometry.conventions import Names, Pair, Range
from mereo.io.bounds import NotNegative, Number, check_value
from mereo.io.cores import limit_blas_threads
from mereo.io.errors import AnyPath, value_text
from mereo.io.yaml_document import Document
from mereo.scenes.draw_recorder import Call, Key, OutOfDraws, Place, Recorder, Shares, Trail
from mereo.scenes.mechanism import Mechanism, joints_alone
from mereo.scenes.random_states import OBJECT_STATES, STATES_SEED, build_model, sample_states
from mereo.scenes.scene import Scene
from mereo.scenes.statistical_model import StatisticalModel

MANY, MANY_NORMAL = 48, 3
"""An array of more numbers than the first, or of more normal ones than the second, gets one slider."""

NORMAL_REACH = 3.0
"""Sliders of normal draws go this many standard deviations to either side."""

RETRIES = 10
"""How often a scene may draw all it needs again before a state counts as refused."""

WITNESSES = 40
"""Vertices of each segment whose motion tells whether two states are the same."""


Given = Mapping[Key, Shares]
"""Shares of draws that are known."""


class Refused(ValueError):
    """Error of a state that a scene does not allow, for example because its parts would touch."""


@dataclass(frozen=True, eq=False)
class Played:
    """State of a scene, and the draws that lead to it.

    Attributes:
        seed: of all that is not given.
        calls: the draws, without attempts that the scene itself has thrown away.
        deformations: for each segment.
        remembered: shares of these draws, and of draws that other states needed.
        turns: for draws with one slider for many numbers, its value, and the shares at 0.
    """

    seed: int
    calls: tuple[Call, ...]
    deformations: Deformations
    remembered: Given
    turns: Mapping[Key, tuple[float, Shares]]

    @property
    def keys(self) -> tuple[Key, ...]:
        """Keys of the draws: the same keys mean the same sliders."""
        return tuple(call.key for call in self.calls)


@dataclass(frozen=True)
class Parameter:
    """Degree of freedom of a scene, as a slider shows it: one number of a draw, or all of them together (index None).

    Values are as the scene draws them, radians in degrees; a normal draw in standard deviations, many numbers together
    in turns. ``whole`` is whether only whole numbers mean something.
    """

    key: Key
    index: int | None
    group: str
    name: str
    unit: str
    low: float
    high: float
    value: float
    whole: bool = False


# --- playing ----------------------------------------------------------------------------------------------------------


def random_state(scene: Scene, seed: int) -> Played:
    """State of a seed. Another seed, another state."""
    return _played(scene, seed, {}, {}, None)


def play(scene: Scene, recorder: Recorder) -> Deformations:
    """Deformations of one run of a scene; ``scenes.draw_recorder`` counts the calls from here on."""
    return scene.sample_deformations(recorder)


def _played_by(scene: Scene, seed: int, recorder: Recorder) -> Played | None:
    """State of the draws that a recorder has; None where the scene refuses them."""
    try:
        deformations = play(scene, recorder)
    except (OutOfDraws, ValueError):  # a scene that gives up raises ValueError
        return None
    calls = tuple(recorder.calls)
    return Played(seed, calls, deformations, {call.key: call.shares for call in calls}, {})


def replayed(scene: Scene, seed: int, given: Given) -> Played | None:
    """State by the shares of its draws, in their order; None where the scene refuses them, or draws others."""
    played = _played_by(scene, seed, Recorder(seed, given, len(given)))
    return played if played is not None and list(played.keys) == list(given) else None


def _played(
    scene: Scene,
    seed: int,
    given: Given,
    turns: Mapping[Key, tuple[float, Shares]],
    before: Played | None,
) -> Played:
    most = None if before is None else RETRIES * (len(before.calls) + 10)
    recorder = Recorder(seed, given, most)
    deformations = play(scene, recorder)
    calls = tuple(recorder.calls)
    if before is None or tuple(call.key for call in calls) != before.keys:
        calls = _without_refused(scene, seed, calls, deformations)
    calls = _renumbered(calls)
    return Played(seed, calls, deformations, {**given, **{call.key: call.shares for call in calls}}, turns)


def _renumbered(calls: Sequence[Call]) -> tuple[Call, ...]:
    """Calls with keys counted again where calls were left out."""
    seen = Counter[Place]()
    result = []
    for call in calls:
        place = call.key[0]
        result.append(replace(call, key=(place, seen[place])))
        seen[place] += 1
    return tuple(result)


def _without_refused(scene: Scene, seed: int, calls: tuple[Call, ...], deformations: Deformations) -> tuple[Call, ...]:
    """The draws that matter: those of attempts that the scene threw away are left out.

    A run of draws that starts where a later one starts again is left out, if without it the scene draws exactly the
    rest and deforms alike. This is a test of the scene's behaviour, so it needs to know nothing of its loops.
    """
    wanted = _witness(scene, deformations)
    first = 0
    while first < len(calls):
        again = [k for k in range(len(calls) - 1, first, -1) if calls[k].key[0] == calls[first].key[0]]
        for later in again:
            kept = calls[:first] + calls[later:]
            played = replayed(scene, seed, {call.key: call.shares for call in _renumbered(kept)})
            if played is not None and np.array_equal(_witness(scene, played.deformations), wanted):
                calls = kept
                break
        first += 1
    return calls


def _witness(scene: Scene, deformations: Deformations) -> Float[ndarray, "w 3"]:
    """Where a few vertices of each segment go."""
    return np.concatenate(
        [
            deformation(segment.vertices[:: max(1, len(segment.vertices) // WITNESSES)])
            for segment, deformation in zip(scene.rest.segments, deformations, strict=True)
        ]
    )


# --- sliders ----------------------------------------------------------------------------------------------------------


def parameters(played: Played) -> tuple[Parameter, ...]:
    """Degrees of freedom of this state, in the order in which they are drawn, with names that differ in a group."""
    sliders = list[Parameter]()
    titles = [_title(call) for call in played.calls]
    seen = Counter[tuple[str, Names]]()
    for call, (group, names) in zip(played.calls, titles, strict=True):
        seen[group, names] += 1
        if titles.count((group, names)) > 1:
            names = tuple(f"{name} {seen[group, names]}" for name in names)
        if len(call.shares) > (MANY_NORMAL if call.kind == "normal" else MANY):
            turn = played.turns.get(call.key, (0.0, call.shares))[0]
            sliders.append(Parameter(call.key, None, group, names[0], "turns", 0.0, 1.0, turn))
        else:
            sliders += [_parameter(call, index, group, name) for index, name in enumerate(_numbered(call, names))]
    return tuple(parameter for parameter in sliders if parameter.high > parameter.low)


def _title(call: Call) -> tuple[str, Names]:
    """Group of a draw, and its name or those of its numbers: as the scene calls them, else as the source does."""
    group, *inner = call.name.parts or ("whole",)
    names = (call.name.name,) if isinstance(call.name.name, str) else call.name.name
    return group, tuple(" ".join([*inner, name or _source_name(call.trail)]) for name in names)


def _source_name(trail: Trail) -> str:
    """The variable that a draw's source line assigns, as words; where there is none, the function that draws."""
    code, instruction = trail[-1]
    line = list(code.co_positions())[instruction // 2][0]
    assigned = re.match(r"\s*(\w+)\s*(:[^=]+)?[-+*/]?=(?!=)", linecache.getline(code.co_filename, line or 0))
    name = assigned[1] if assigned else re.sub("<.*>", "draw", code.co_name)
    return name.strip("_").replace("_", " ")


def _numbered(call: Call, names: Names) -> Names:
    """A name for each number of a draw: x, y and z of a vector, else a count, where they share one."""
    count = len(call.shares)
    if len(names) == count:
        return names
    ends = "xyz" if call.shape == (3,) and call.kind != "permutation" else range(1, count + 1)
    return tuple(f"{names[0]} {end}" for end in ends)


def _parameter(call: Call, index: int, group: str, name: str) -> Parameter:
    low, high, share = float(call.low[index]), float(call.high[index]), float(call.shares[index])
    if call.kind == "normal":
        value = float(np.clip(ndtri(share), -NORMAL_REACH, NORMAL_REACH))
        return Parameter(call.key, index, group, name, "σ", -NORMAL_REACH, NORMAL_REACH, value)
    if call.kind in ("integers", "choice"):
        value = low + np.floor(share * (high - low))
        if call.ends is not None:
            value = np.minimum(np.searchsorted(call.ends, share, side="right"), high - 1)
        return Parameter(call.key, index, group, name, "", low, high - 1, float(value), whole=True)
    factor, unit = (180 / pi, "°") if call.name.unit == "rad" else (1.0, call.name.unit)
    low, high = low * factor, high * factor
    return Parameter(call.key, index, group, name, unit, low, high, low + share * (high - low))


def set_value(scene: Scene, played: Played, parameter: Parameter, value: float) -> Played:
    """State with one degree of freedom at another value, within its bounds.

    Draws that only the new state needs are random, and those of the old one are remembered for the way back. Raises
    ``Refused`` where the scene does not take the value.
    """
    call = next(call for call in played.calls if call.key == parameter.key)
    turns = dict(played.turns)
    if parameter.index is None:
        start = turns.get(call.key, (0.0, call.shares))[1]
        turns[call.key] = (value, start)
        shares = turned(start, value, crc32(repr(call.key).encode()) + played.seed)
    else:
        shares = call.shares.copy()
        shares[parameter.index] = _share(call, parameter, value)
    given = {**played.remembered, call.key: shares}
    with suppress(OutOfDraws, ValueError):  # a scene that gives up raises ValueError
        result = _played(scene, played.seed, given, turns, played)
        taken = next((c for c in result.calls if c.key == call.key), None)
        if taken is not None and np.allclose(taken.shares, shares, atol=1e-6):
            return result
    raise Refused(
        f"the scene refuses this value of {parameter.name!r} ({parameter.group}): with the other values as they are, "
        "its parts would touch, or fold over; the last state that it allows is shown: move another slider first"
    )


def turned(shares: Shares, turn: float, seed: int | Pair) -> Shares:
    """Shares of many numbers moved at once, so that they stay as random as they were.

    As normal numbers z they go round a circle through other ones w: z cos + w sin has the same distribution everywhere
    on it (elliptical slice sampling, Murray et al., AISTATS 2010, walks on the same curve). 0 and 1 are the start.
    """
    other = default_rng(seed).normal(size=len(shares))
    angle = 2 * pi * turn
    return ndtr(np.cos(angle) * ndtri(shares) + np.sin(angle) * other)


def _share(call: Call, parameter: Parameter, value: float) -> float:
    value = min(max(value, parameter.low), parameter.high)
    if call.kind == "normal":
        return float(ndtr(value))
    if call.ends is not None:  # the middle of the option's share
        return float(np.interp(round(value) + 0.5, np.arange(len(call.ends) + 1), [0.0, *call.ends]))
    if call.kind == "integers":
        return float((np.rint(value) - parameter.low + 0.5) / (parameter.high - parameter.low + 1))
    return float((value - parameter.low) / (parameter.high - parameter.low))


# --- draws played back ------------------------------------------------------------------------------------------------

# A key says where in the scene's code a draw comes from, and so belongs to one version of it; an order may be written
# to a file.


class _InOrder(Recorder):
    """Recorder that is given its draws in the order of the calls; more or other ones raise ``OutOfDraws``."""

    def __init__(self, seed: int, shares: Sequence[ndarray]) -> None:
        super().__init__(seed, {})
        self._shares = shares

    def _chosen(self, key: Key, size: int) -> Shares:
        number = len(self.calls)
        if number >= len(self._shares) or len(self._shares[number]) != size:
            raise OutOfDraws
        return self._shares[number]


def played_back(scene: Scene, seed: int, shares: Sequence[ndarray]) -> Played:
    """State of a scene by the shares of each call; raises ``Refused`` where it does not take them."""
    played = _played_by(scene, seed, _InOrder(seed, shares))
    if played is None:
        raise Refused(
            f"the scene {scene.name!r} does not take these {len(shares)} draws; they are of another scene, or of "
            "another version of it: register the frame again"
        )
    return played


def draw_names(played: Played) -> Names:
    """Name of each number in the order of the draws, as its slider is called; "" for one that cannot vary."""
    sliders = {(slider.key, slider.index): f"{slider.group}: {slider.name}" for slider in parameters(played)}
    numbers = [(call.key, index) for call in played.calls for index in range(len(call.shares))]
    return tuple(
        f"{sliders[key, None]} {index + 1}" if (key, None) in sliders else sliders.get((key, index), "")
        for key, index in numbers
    )


# --- joints whose values are given ------------------------------------------------------------------------------------

ROUNDING = 1e-3
"""Share of a joint's range by which a value may lie beyond its limits, or off the joint that it follows."""


def with_joints(scene: Scene | None, given: Any) -> Scene:
    """Scene whose joints lie where an encoder or a person knows them; those of which nothing is given, as they did.

    Args:
        scene: with joints that have names.
        given: values by these names, each a number, a result's ``JointValue``, or a dict of ``value`` and ``within``,
            the largest error; radians, or metres of joints that slide. Or lists ``name`` and ``position``, as a dict
            or a ``JointState`` of ROS, of which joints that the scene lacks are passed over. Or a YAML or JSON file.

    A joint that follows another one gives that one's value. What was given before still holds: a value within it
    narrows it, and another one contradicts it. Raises ``FileNotFoundError``, and ``ValueError`` where the scene has no
    joints with names, for names that none has, values beyond limits, and two that contradict.
    """
    motion = None if scene is None else scene.sample_deformations
    if scene is None or not isinstance(motion, RandomMotion) or not motion.joints:
        raise ValueError(
            "joints are given, but the object has none with a name: leave them out, or write a scene file in which its "
            "joints have names"
        )
    if isinstance(given, AnyPath):
        content = Document(Path(given), "file of joints", "JOINT:").data
        try:
            return with_joints(scene, content)
        except ValueError as error:
            raise ValueError(f"{given}: {error}") from None
    shares = dict[str, Range]()
    for name, (value, within) in _values(given, list(motion.joints)).items():
        joint, _ = motion.joints[name]
        leader = joint.follows or name
        given_before = motion.joints[leader][0].shares
        before = shares.get(leader, given_before)
        least, most = _shares(joint, value, within, before, scene.unit_m or 1.0)
        if before != (0.0, 1.0):  # of a joint of which nothing is known a whole turn goes on beyond its limits
            least = max(least, before[0])
            most = min(most, before[1])
        if least > most + ROUNDING:
            others, cure = (
                ("what was given before, with the object", "leave one of both out")
                if before == given_before
                else ("others that move with it", f"give {leader!r} alone")
            )
            raise ValueError(f"joint {name!r} is {value:.6g}, which contradicts {others}: {cure}")
        shares[leader] = min(least, most), most
    return replace(scene, sample_deformations=motion.narrowed(shares))


def with_frame_joints(scene: Scene | None, given: Any) -> Scene:
    """Scene ``with_joints`` of one frame of a sequence; raises ``ValueError`` also where more moves than joints."""
    known = with_joints(scene, given)
    if joints_alone(known) is None:
        raise ValueError(
            "values of joints are given with a frame, but the object bends as well: give those that stay as they are "
            "before the first frame"
        )
    return known


def narrowed_model(scene: Scene, model: StatisticalModel) -> StatisticalModel:
    """Statistical model of the states of a scene ``with_joints``, with the material points of ``model``, its object's.

    It is made in seconds, at once of a mechanism and where all values are known.
    """
    mechanism = Mechanism.of(scene, model)
    if isinstance(mechanism, Mechanism):
        return mechanism
    motion = scene.sample_deformations
    assert isinstance(motion, RandomMotion)
    joints = [joint for joint, _ in motion.joints.values()]
    count = OBJECT_STATES if parameters(random_state(scene, STATES_SEED)) else 2
    states = sample_states(scene, model.nodes, model.node_labels, count, STATES_SEED)
    with limit_blas_threads():
        made = build_model(model.rest, model.nodes, model.node_labels, states)
    rests = all(joint.shares[0] <= joint.share(0.0) <= joint.shares[1] for joint in joints)
    return replace(made, source_frame=model.source_frame, rests=rests)


def _values(given: Any, names: list[str]) -> dict[str, Range]:
    """Value of each joint that is given, and its largest error."""
    if hasattr(given, "position"):  # a message
        given = {"name": given.name, "position": given.position}
    if isinstance(given, Mapping) and given.keys() >= {"name", "position"}:
        listed, positions = given["name"], given["position"]
        are_lists = isinstance(listed, list | tuple) and isinstance(positions, Sized)
        if not are_lists or len(listed) != len(positions):
            raise ValueError(
                f"`name` is {value_text(listed)} and `position` {value_text(positions)}; they must be lists of one "
                "length: correct them"
            )
        given = {name: value for name, value in zip(listed, positions, strict=True) if name in names}
    if not isinstance(given, Mapping) or not given:
        raise ValueError(
            f"the joints are {value_text(given)}; they must be values by name, of {', '.join(names)}: give for example "
            f"{{{names[0]!r}: 0.1}}"
        )
    values = dict[str, Range]()
    for name, value in given.items():
        if name not in names:
            raise ValueError(f"no joint is called {name!r}; it must be one of {', '.join(names)}: correct it")
        parts = {"within": 0.0, **(value if isinstance(value, Mapping) else {"value": getattr(value, "value", value)})}
        if parts.keys() != {"value", "within"}:
            raise ValueError(
                f"joint {name!r} is {value_text(value)}; it must be a number, or `value` and `within`, its largest "
                "error: correct it"
            )
        check_value(f"joint {name!r}", parts["value"], Number, 0.1)
        check_value(f"`within` of joint {name!r}", parts["within"], NotNegative, 0.01)
        values[name] = float(parts["value"]), float(parts["within"])
    return values


def _shares(joint: JointSampler, value: float, within: float, before: Range, unit_m: float) -> Range:
    """Least and greatest share of a joint's range by its value in radians or metres, of the turn of those before."""
    stated = value
    unit, turn, name = (1.0, 2 * pi, "rad") if joint.turns else (unit_m, np.inf, "m")
    first, second = (unit * limit for limit in joint.limits)
    goes_on = abs(second - first) > turn - ROUNDING
    if joint.turns:  # a whole turn more is the same state
        middle = sum(before) / 2 if goes_on else 0.5
        value -= turn * round((value - first - middle * (second - first)) / turn)
    low, high = sorted((value + side - first) / (second - first) for side in (-within, within))
    if goes_on:  # beyond the limits of a whole turn
        return low, high
    if low > 1 + ROUNDING or high < -ROUNDING:
        least, most = sorted((first, second))
        limits = f"{least:.6g} to {most:.6g} {name}"
        words = "radians" if joint.turns else "metres"
        text = f"joint {joint.name!r} is {stated:.6g}; its limits are {limits}: "
        raise ValueError(f"{text}give {words}, correct it, or add `within`")
    least, most = np.clip([low, high], 0.0, 1.0).tolist()
    return least, most
