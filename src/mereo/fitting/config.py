"""Settings and constants of the fit; light, so that the command line may import them."""

from dataclasses import dataclass, replace
from typing import Literal

AnswerMethod = Literal["auto", "network", "search", "modes", "full"]
"""Source of the answer to a frame: the registered model where that explains the frame, else the network; the network
alone; the registered model in any case, found by a search without the network, or by its modes or the draws of its
scene as well."""

FoundBy = Literal["search", "network"]
"""Who found the object in a frame: a search over poses and states, or a trained network."""

Tracking = Literal["found", "followed", "lost"]
"""State of a tracked object in a frame: found anew; followed from the last frame; or lost, so that its pose is not
known."""


@dataclass(frozen=True)
class FitConfig:
    """Constants of the fit; lengths are shares of half the rest box's longest side where not said otherwise.

    Attributes:
        start_sigma: standard deviation of the network's correspondences.
        first_steps: steps on the correspondences alone, their sigma falling from ``first_widening`` times to once.
        first_weight: how many independent points the correspondences are worth in these.
        last_steps: steps on cloud, silhouette and correspondences; the cloud's sigma falls by ``cooling`` in each.
        cloud_sigma: last standard deviation of the cloud, in scene units, where its noise is not larger.
        cloud_weight: how many independent points the cloud is worth.
        network_weight: the same of the correspondences, at the first and at the last of these steps.
        pair_weight: the same of the distances that the states keep.
        pair_slack: how far these distances may be off at first; it falls by ``pair_cooling`` in each step.
        damping: of every step, relative to the diagonal.
        neighbors: states of the library around an answer whose Gaussian is the prior of the next.
        neighbor_std: standard deviation of each coefficient that is added to theirs.
        refine_sigma, refine_steps: the cloud's first sigma, and steps, under the prior of the neighbours.
        explained: the cloud's misfit, in squared standard deviations of a sample, above which other states are tried.
        tries, per_joint: states of the library that are tried, and states of each joint that differ in it alone.
        screened, screen_steps: how many of either are drawn towards the frame by few points, and in how many steps.
        refined, last_widening, last_refine: how many are refined, from which ``refine_sigma`` and in how many steps.
        rounds: how often other states are tried.
        curved: other states are tried only where this many distances are kept: smooth bending has one optimum.
        samples, coarse_samples: points of the surface that stand for it in most steps, and in the choice of states.
        silhouette_vertices: how many of them are compared with what the frame rules out.
        exact_steps: last steps, which ask the faces themselves.
        search_rounds: rounds of the search at most, while nothing explains the frame.
        scale_std: standard deviation of the scale's logarithm where the unit is not known.
        accepted, tolerance: a fit is believed where this share of the observed points lies as near its facing surface,
            in scene units.
        turned: whether the network is asked again, with the camera turned, where much is unexplained: seconds a frame.
        turned_anyway: whether it is, however much noise that may be: for frames that nothing else explains.
        agreed, accepted_agreed: where the network and the fit give as large a share of the correspondences on the
            object's surface the same segment, this smaller share is enough.
    """

    start_sigma: float = 0.06
    first_steps: int = 8
    first_widening: float = 2.5
    first_weight: float = 500.0
    last_steps: int = 15
    cooling: float = 0.75
    cloud_sigma: float = 0.2
    cloud_weight: float = 3000.0
    network_weight: tuple[float, float] = (60.0, 10.0)
    pair_weight: float = 100.0
    pair_slack: float = 0.05
    pair_cooling: float = 0.7
    damping: float = 1e-3
    neighbors: int = 50
    neighbor_std: float = 0.17
    refine_sigma: float = 0.02
    refine_steps: int = 10
    explained: float = 0.147
    tries: int = 12
    per_joint: int = 4
    screened: int = 8
    screen_steps: int = 4
    last_widening: float = 1.0
    last_refine: int = 8
    refined: int = 2
    rounds: int = 2
    curved: int = 300
    search_rounds: int = 3
    scale_std: float = 0.1
    samples: int = 3000
    coarse_samples: int = 1000
    silhouette_vertices: int = 500
    exact_steps: int = 3
    accepted: float = 0.95
    tolerance: float = 0.45
    turned: bool = True
    turned_anyway: bool = False
    agreed: float = 0.8
    accepted_agreed: float = 0.85


@dataclass(frozen=True)
class DrawsConfig:
    """Constants of the fit of draws.

    Attributes:
        starts: random states that are compared with a shape, the most like it.
        sieve: sets of differences spent on each start, and on how many of the best, one stage after the other.
        kept: how many of them are then fitted to the frame.
        met: misfit up to which a start meets a shape; beyond, ``choices`` states with other discrete draws are tried,
            and the ``chosen`` most like the shape approach it.
        shape_std: standard deviation of the shape that the modes found, as a share of half the rest box's longest side.
        shape_weight: how many independent points a shape is worth.
        cloud_weight, network_weight: the same of the cloud and of the correspondences, from beginning to end, also
            where draws and modes are compared.
        first_rounds, last_rounds: sets of differences in the fit to the frame, after a jump and else.
        steps: at most with one set of differences.
        tries: dampings at most in one step.
        damping: the first one, relative to the diagonal.
        cooling: of the cloud's sigma in each step.
        gain: relative gain of a step below which nothing more is tried.
        explained: the cloud's misfit above which the network's answer is a start too, and draws may jump.
        hopeless: the same, above which the next starts are tried, in at most ``batches`` of them.
        passes: while it is above ``hopeless``, how often the modes are refined from where the draws ended, and the
            draws fitted to that shape again.
        jumps: how often one draw may jump to another place of its range.
        jump_steps, jumps_kept: into how many even steps its range is divided, so that a draw may jump to one position
            fewer; and how many of these, the best, are compared: all where None.
        sliding: most share of a draw's motion that may leave the surface; 1 lets all draws jump.
        turned_worse: misfit by which a state may be worse with segments stiffly turned that look alike turned
            (``turned_segments``), for that shape to be tried.
        turned_sieve: ``sieve`` for it; one start is then fitted to the frame.
        network_start: whether the network's answer is a start too, where the cloud is not explained.
        every_point: whether the answer is fitted to every observed point in the end.
        few: scenes with more draws than this get ``MANY_DRAWS`` instead: every set of differences plays each draw once.
        near: how many states count as near where draws are guessed from the modes.
        start_sigma: the cloud's first sigma, as a share of half the rest box's longest side.
    """

    starts: int = 40
    kept: int = 2
    met: float = 100.0
    choices: int = 100
    chosen: int = 4
    sieve: tuple[tuple[int, int], ...] = ((1, 10), (1, 3))
    shape_std: float = 0.04
    shape_weight: float = 500.0
    cloud_weight: float = 1500.0
    network_weight: float = 30.0
    first_rounds: int = 1
    last_rounds: int = 2
    steps: int = 6
    tries: int = 3
    damping: float = 0.03
    cooling: float = 0.6
    gain: float = 0.003
    explained: float = 0.125
    hopeless: float = 0.25
    batches: int = 1
    passes: int = 0
    jumps: int = 2
    jump_steps: int = 6
    jumps_kept: int | None = None
    sliding: float = 1.0
    turned_worse: float = 25.0
    turned_sieve: tuple[tuple[int, int], ...] = ((1, 4), (1, 1))
    network_start: bool = True
    every_point: bool = True
    few: int = 30
    near: int = 100
    start_sigma: float = 0.03


MANY_DRAWS = DrawsConfig(
    cloud_weight=3000.0,
    network_weight=10.0,
    batches=2,
    passes=1,
    starts=16,
    kept=1,
    sieve=((1, 3), (1, 1)),
    first_rounds=1,
    last_rounds=4,
    jump_steps=12,
    jumps_kept=1,
    sliding=0.2,
    network_start=False,
    every_point=False,
)
"""Constants for scenes with many draws."""


StreamMethod = Literal["auto", "network", "search", "modes"]
"""Source of the answers to a sequence, as ``AnswerMethod``; draws take longer than the time between two frames."""

MotionModel = Literal["pose", "velocity"]
"""What is expected of the next frame: the last state, or the last state moved on as it has moved."""


@dataclass(frozen=True)
class TrackConfig:
    """Constants of following an object.

    Attributes:
        motion: what is expected of the next frame.
        speed: standard deviation of a material point's way from there, scene units per second.
        gain: how many times its present speed is added to that: what is still stays still, what moves may turn.
        dead: speed that noise alone makes a still object seem to have, which is not counted, neither here nor in where
            it is expected; scene units per second.
        first_speed: the same while nothing is known of its motion, right after the network was asked.
        least: standard deviation in however short a time, scene units.
        smoothing: share of what a frame says of the motion that is believed, the rest is what was known before.
        motion_weight: how many independent points the expectation is worth, in each direction.
        points: denser clouds are averaged to so many points.
        observed_samples: observed points, evenly spread, that are compared with the surface.
        first_sigma: the cloud's first standard deviation, as a share of half the rest box's longest side; it falls by
            ``cooling`` in each step to that of the frame's noise.
        steps, exact_steps: steps that ask samples of the surface, and last ones that ask its faces.
        gate: distance from the expected surface beyond which a point is left out, as a share of the same half.
        drop: share of the points by which a frame may be explained less than the best since the network was asked.
        margin: share of the points that a frame's own fit must explain more than a lost track to take its place.
        least_area: share of the greatest area that was ever seen of the object, below which it is lost.
        most_ruled_out: share of the surface that the frame may rule out before the object is lost.
        scale_std: standard deviation of the scale's logarithm from frame to frame, where the unit is not known.
        longest_s: a longer time without a frame ends the track.
    """

    motion: MotionModel = "velocity"
    speed: float = 1.0
    gain: float = 10.0
    dead: float = 0.5
    first_speed: float = 20.0
    least: float = 0.02
    smoothing: float = 0.2
    motion_weight: float = 300.0
    points: int = 2000
    observed_samples: int = 500
    first_sigma: float = 0.04
    cooling: float = 0.5
    steps: int = 3
    exact_steps: int = 1
    gate: float = 0.25
    drop: float = 0.05
    margin: float = 0.02
    least_area: float = 0.15
    most_ruled_out: float = 0.3
    scale_std: float = 0.002
    longest_s: float = 1.0

    @property
    def patient(self) -> "TrackConfig":
        """The same with more steps, the first of them wider: for what has moved far since the last frame."""
        return replace(self, steps=4 * self.steps, first_sigma=2 * self.first_sigma, cooling=0.75)
