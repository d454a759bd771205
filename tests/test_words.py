"""Sizes in words, and files of one error."""

import math

import pytest

from fitting.diagnosis import unusable
from fitting.report.banner import headline
from magjax.words import sized


@pytest.mark.parametrize(
    ("unit", "values", "told"),
    [
        ("m", (1.2e-7, 4.7e-8), "120 -> 47 nm"),
        ("m", (4.7e-8, 1.2e-6), "0.047 -> 1.2 um"),
        ("m", (9.996e-7,), "1 um"),
        ("m", (9.99e-7,), "999 nm"),
        ("m", (-2e-5,), "-20 um"),
        ("m", (0.0,), "0 m"),
        ("m", (48.3,), "48.3 m"),
        ("m", (1e-15,), "0.001 pm"),
        ("T", (2.7e-3,), "2.7 mT"),
        ("A/m", (1234.0,), "1.23e+03 A/m"),
        ("1", (3.56e-6,), "3.56e-06"),
        ("", (0.5,), "0.5"),
    ],
)
def test_a_size_is_told_by_the_prefix_that_suits_it(unit, values, told):
    assert sized(unit, *values) == told


def test_digits_and_ranges():
    assert sized("m", 1.7061e-5, 5.2878e-5, digits=5, joined=" .. ") == "17.061 .. 52.878 um"
    assert sized("m", math.nan) == "nan m"
    assert sized("m", 1.434e-7, digits=2) == "140 nm" and sized("Hz", 1234.0) == "1230 Hz"  # without a power of ten


def test_the_same_error_of_many_files_is_said_once():
    several = [f"fit_{k:02d}.csv: current reaches {800 + 1.5 * k:.4g} A, more than any such bench gives" for k in range(9)]
    assert unusable(several).message == f"{several[0]} (the same of 8 other files)."
    two = unusable([several[0], "fit_05.csv: displacement is infinite at sample 3", several[1]])
    assert two.message == f"{several[0]} (the same of fit_01.csv). fit_05.csv: displacement is infinite at sample 3."
    assert two.data_problem == several[0]


@pytest.mark.parametrize(("count", "named"), [(1, "fit_00.csv"), (3, "fit_00.csv and fit_01.csv and fit_02.csv"), (9, "fit_00.csv and 8 other files")])
def test_the_headline_names_all_that_share_an_error(count, named):
    found = unusable([f"fit_{k:02d}.csv: displacement is infinite at sample {k}" for k in range(count)])
    assert headline(found.as_dict()).startswith(f"{named} must be mended first")
