"""A small fit that the tests of intervals share."""

import dataclasses

import numpy as np
import pytest

from fitting.demo import concealed_actuator, record
from fitting.fit import fit
from fitting.setup import Choices
from magjax.bench import load_bench

QUICK = Choices(fine=250, harmonics=30)
SINES = ((10, 0.8, 0.1), (80, 0.5, -0.2), (250, 0.8, 0.1))


@pytest.fixture(scope="session")
def truth():
    return concealed_actuator(load_bench("aa-050h"))


@pytest.fixture(scope="session")
def recordings(truth):
    rng = np.random.default_rng(3)
    return [record(truth, *drive, rng, f"rec_{drive[0]:03d}.csv") for drive in SINES]


@pytest.fixture(scope="session")
def result(recordings):
    return fit(recordings, "aa-050h", choices=QUICK, refine=False)


@pytest.fixture(scope="session")
def quick():
    return dataclasses.replace(QUICK)
