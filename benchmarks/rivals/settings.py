"""Settings of the rivals: as documented, what is searched, and what the search found."""

from dataclasses import dataclass, field
from typing import Any

from rivals.methods import (
    Method,
    Settings,
    affine_cpd,
    atlas_cpd,
    bayesian_cpd,
    deformable_cpd,
    icp,
    rigid_cpd,
    stay,
)

COMMON: Settings = {"facing": False, "count": 500}
MIXTURE: dict[str, list[Any]] = {"facing": [True], "sigma2": [0.1, 0.02, 0.005], "w": [0.1, 0.3]}
ATLAS: dict[str, list[Any]] = {"facing": [True], "sigma2": [0.1, 0.02, 0.005], "outlier_weight": [0.1, 0.3]}


@dataclass(frozen=True, eq=False)
class Rival:
    """One rival.

    Attributes:
        run: the method.
        default: its documented settings, with all of the visible surface as source.
        search: values that are tried for each setting, one setting after the other.
        tuned: what differs from ``default`` in the settings that the search found.
        mean: whether it starts from the statistical model's mean instead of the rest state.
    """

    run: Method
    default: Settings
    search: dict[str, list[Any]] = field(default_factory=dict)
    tuned: Settings = field(default_factory=dict)
    mean: bool = False


RIVALS: dict[str, Rival] = {
    "start pose": Rival(stay, {}),
    "ICP": Rival(
        icp,
        {"facing": False},
        {
            "facing": [True],
            "max_correspondence_distance": [2.0, 4.0, 8.0],
            "registration_type": ["PLANE_ICP", "ICP"],
            "downsampling_resolution": [0.05, 1.0],
            "max_iterations": [100],
        },
        {"registration_type": "ICP"},
    ),
    "rigid CPD": Rival(
        rigid_cpd, COMMON | {"scale": True}, {"scale": [False]} | MIXTURE, {"facing": True, "sigma2": 0.1}
    ),
    "affine CPD": Rival(affine_cpd, COMMON, MIXTURE, {"facing": True, "sigma2": 0.005}),
    "deformable CPD": Rival(
        deformable_cpd,
        COMMON | {"fast": False},
        MIXTURE | {"beta": [1.0, 0.5, 0.25], "alpha": [0.5, 8.0, 32.0, 128.0], "tolerance": [1e-5], "count": [1000]},
        {"fast": True, "facing": True, "sigma2": 0.02, "w": 0.1, "tolerance": 1e-5, "count": 1000},
    ),
    "Bayesian CPD": Rival(
        bayesian_cpd,
        COMMON,
        {"facing": [True], "gamma": [0.1, 0.02], "lmd": [20.0, 200.0, 2000.0], "w": [0.1, 0.3], "k": [1.0]},
        {"facing": True, "k": 1.0},
    ),
    "atlas CPD": Rival(
        atlas_cpd,
        COMMON | {"scale": True},
        {"scale": [False]}
        | ATLAS
        | {
            "lambda_regularization": [0.01, 1.0, 10.0, 30.0, 100.0],
            "adaptive_mixing": [1.0],
            "tolerance": [1e-5],
            "count": [1000, 2000],
        },
        {
            "scale": False,
            "facing": True,
            "sigma2": 0.1,
            "outlier_weight": 0.1,
            "lambda_regularization": 10.0,
            "tolerance": 1e-5,
            "count": 1000,
        },
        mean=True,
    ),
}
