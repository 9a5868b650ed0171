"""Random numbers of examples: which seeds are for testing, and the generator of each example."""

import numpy as np
from numpy.random import Generator, default_rng

TEST_SEED_START = 1_000_000
"""Seeds from here up are for testing; generation for training refuses them."""


def example_rng(seed: int, index: int) -> Generator:
    """Generator of example ``index``: any example can be remade alone, in any order, by any process."""
    return default_rng(np.random.SeedSequence([seed, index]))
