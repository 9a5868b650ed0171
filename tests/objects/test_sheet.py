"""The sheet folds over itself, in every kind of state, and layers keep apart."""

import numpy as np
import pytest

from mereo.deformation.maps import Deformation, jacobian
from mereo_objects import sheet
from mereo_objects._sheet_parts import THICKNESS, middle_points


def underside_share(deformation: Deformation) -> float:
    """How much of the sheet shows its other side from above than the rest does."""
    _, matrix = jacobian(deformation, middle_points())
    normals = np.cross(matrix[:, :, 0], matrix[:, :, 1])
    up = normals[:, 2] / np.linalg.norm(normals, axis=1)
    return float(min((up < -0.2).mean(), (up > 0.2).mean()))


def first_of_kind(kind: str, seed: int) -> Deformation:
    rng = np.random.default_rng(seed)
    return next(found for found in iter(lambda: sheet.sample_deformation(rng, kind), object()) if found is not None)


@pytest.mark.parametrize("kind", sheet.KINDS[1:])
def test_folds_and_rolls_turn_part_of_the_sheet_over(kind: str) -> None:
    shares = [underside_share(first_of_kind(kind, seed)) for seed in range(8)]
    assert np.median(shares) > 0.05 and max(shares) > 0.15


def test_a_sheet_that_lies_on_itself_is_refused() -> None:
    flat = middle_points()
    assert sheet.is_clear(flat)
    folded = np.where(flat[:, :1] > 0, flat * [-1.0, 1.0, 1.0] + [0.0, 0.0, THICKNESS], flat)
    assert not sheet.is_clear(folded)
