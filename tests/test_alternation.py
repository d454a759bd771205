"""Period doubling is told from drift, hum and slow noise."""

import numpy as np
import pytest

from fitting.alternation import alternating
from fitting.diagnose import Diagnosis
from fitting.floors import data_problem
from fitting.setup import spectra_of
from magjax.bench import load_bench
from magjax.recording import Recording

FREQUENCIES = (10.0, 30.0, 110.0)


def runs(extra, periods=4, frequencies=FREQUENCIES):
    rng = np.random.default_rng(4)
    found = []
    for f in frequencies:
        t = np.arange(300 * periods) / (300 * f)
        current = 0.6 * np.sin(2 * np.pi * f * t)
        y = 3e-5 + 1e-5 * current + 3e-6 * current**3
        y = y + extra(t, y, f) + 4e-8 * rng.standard_normal(len(t))
        found.append(Recording(t, {"current": current, "displacement": y}, name=f"{f:g} Hz"))
    return found


def alternation_of(extra, periods=4):
    bench = load_bench("aa-050h")
    recordings = runs(extra, periods)
    return alternating(recordings, spectra_of(recordings, bench), bench.output)


@pytest.mark.parametrize("periods", [3, 4, 5])
def test_every_second_period_larger(periods):
    def doubled(t, y, f):
        return 0.01 * (y - 2e-5) * np.where(np.floor(t * f + 1e-9) % 2 == 0, 1, -1)

    found = alternation_of(doubled, periods)
    assert found.size == pytest.approx(0.01, abs=4 * found.stderr) and found.stderr < 0.001 and found.share > 0.95
    bench = load_bench("aa-050h")
    assert alternating(found.cleaned, spectra_of(found.cleaned, bench), bench.output) is None
    told = found.told(Diagnosis("nothing_missing", "nothing is missing."))
    assert told.verdict == "unknown_at" and told.unknown["block"] == "mechanics" and "nothing missing" in told.message


@pytest.mark.parametrize("periods", [3, 4])
@pytest.mark.parametrize(
    "extra",
    [
        lambda t, y, f: 0.0 * y,
        lambda t, y, f: 2e-6 * t / t[-1],
        lambda t, y, f: 3e-7 * np.sin(2 * np.pi * 55 * t),
        lambda t, y, f: 3e-6 * np.exp(-3 * t * f),
    ],
    ids=["noise", "drift", "hum", "transient"],
)
def test_silent_on_what_is_no_alternation(extra, periods):
    assert alternation_of(extra, periods) is None


def test_a_decay_that_took_part_of_it_is_given_back():
    """At 700 Hz half the frequency lies where the rod swings: a start that decays was taken out of the record, and half of the
    alternation with it, so that what was left was refused as unsettled."""
    bench = load_bench("aa-050h")

    def doubled(t, y, f):
        return 0.05 * (y - 2e-5) * np.cos(np.pi * f * t)

    recordings = runs(doubled, frequencies=(10.0, 110.0, 700.0))
    spectra = spectra_of(recordings, bench)
    assert [s.start is not None for s in spectra] == [False, False, True]
    found = alternating(recordings, spectra, bench.output)
    swings = [np.ptp(r.repeats("displacement"), axis=0).max() for r in (recordings[2], found.cleaned[2])]
    assert swings[1] < 0.2 * swings[0] and data_problem(list(found.cleaned), spectra_of(found.cleaned, bench), bench.output) is None


def test_two_periods_do_not_tell():
    """They differ by drift as well."""
    assert alternation_of(lambda t, y, f: 1e-6 * (np.floor(t * f + 1e-9) % 2), 2) is None
