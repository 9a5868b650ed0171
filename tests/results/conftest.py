"""The object of most tests of the fit."""

import pytest

from mereo.scenes.statistical_model import StatisticalModel


@pytest.fixture(scope="session")
def model(toy_model: StatisticalModel) -> StatisticalModel:
    return toy_model
