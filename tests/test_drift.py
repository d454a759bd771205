"""What adds to a record besides the loop: drift at a common rate, of each record by itself, hum; and check recordings without it."""

import dataclasses
import importlib
from types import SimpleNamespace

import numpy as np
import pytest

from fitting.diagnosis import Diagnosis
from fitting.floors import data_problem
from fitting.own_signals import drifts_of_one, record_level
from fitting.record_level import (
    RecordEffect,
    lone_drifts,
    record_effects,
    remove_from_checks,
    remove_record_effect,
    score_of,
    steadiness,
    zeros_of,
)
from fitting.rows import ties_of
from fitting.setup import Choices, spectra_of
from fitting.spectra import Noise, fit_lines
from magjax.bench import load_bench
from magjax.recording import Recording

module = importlib.import_module("fitting.diagnose")  # not the function
BENCH = load_bench("aa-050h")
FREQUENCIES = (10.0, 50.0, 120.0, 300.0)
NOISE = 4e-8


def records(beside=lambda t: 0.0, frequencies=FREQUENCIES, seed=4):
    """Four periods of a bent loop with noise, and what `beside` adds to each."""
    rng, runs = np.random.default_rng(seed), []
    for f in frequencies:
        t = np.arange(2000) / (500 * f)
        current = 0.8 * np.sin(2 * np.pi * f * t)
        y = 2e-5 + 2e-5 * current + 5e-6 * current**3 + NOISE * rng.standard_normal(len(t)) + beside(t)
        runs.append(Recording(t, {"current": current, "displacement": y}, name=f"{f:g} Hz"))
    return runs


def scored(runs):
    """Record-level effects of recordings, best first."""
    return record_effects(runs, spectra_of(runs, BENCH))


def test_nothing_beside_the_loop_scores():
    assert max(abs(e.z) for e in scored(records())) < 4


def test_a_common_rate_is_one_drift():
    best = next(e for e in scored(records(lambda t: 2e-6 * t)) if e.name == "zero_drift")
    assert best.z > 10 and not best.shapes
    assert best.amplitude == pytest.approx(2e-6, abs=4 * best.stderr) and best.stderr < 2e-7


@pytest.mark.parametrize(("rate", "found"), [(1.5e-7, True), (5e-8, False)])
def test_a_weak_drift_is_taken_out_where_nothing_else_scores_so_high(rate, found):
    """A rod's warming of 0.2 % scored 6.6 and stayed in the readings; what does not drift scores 3.4 at most."""
    runs = records(lambda t: rate * t)
    z = max(abs(e.z) for e in scored(runs))
    assert 6 < z < 8 if found else z < 5.5
    adopted, _ = record_level(runs, spectra_of(runs, BENCH), BENCH, Choices())
    assert [{e.name, *(r.name for r in rivals)} for e, rivals in adopted] == ([{"thermal_drift", "zero_drift"}] if found else [])


def flicker(rng, samples, times=16):
    """Noise of one over f that goes on below the length of a record, as a sensor's does."""
    f = np.fft.rfftfreq(times * samples)
    waves = rng.standard_normal(len(f)) + 1j * rng.standard_normal(len(f))
    slow = np.fft.irfft(waves / np.sqrt(np.maximum(f, f[1])), times * samples)
    return 3 * NOISE * (slow / np.std(slow))[:samples]


@pytest.mark.parametrize("seed", [13, 237])
def test_flicker_below_the_length_of_the_records_is_no_drift(seed):
    """It scores 6 and more in one set of sixty, and came out as thermal_drift beside two effects."""
    rng = np.random.default_rng(seed)
    runs = records(lambda t: flicker(rng, len(t)), (10.0, 50.0, 120.0))
    assert max(abs(e.z) for e in scored(runs) if e.name != "mains_hum") > 6
    assert record_level(runs, spectra_of(runs, BENCH), BENCH, Choices())[0] == []


def test_a_record_tells_of_a_drift_what_flicker_leaves():
    """The score of a straight line has a standard deviation of one in noise of any colour that goes on below."""
    rng, scores, t = np.random.default_rng(5), [], np.arange(1000.0)
    noise = Noise(1e-4 * NOISE**2, (3 * NOISE) ** 2 / (2 * np.sum(1 / np.arange(1, 8001))))
    line = RecordEffect("zero_drift", 0.0, 1.0, 1.0, {}, (t,))
    for _ in range(200):
        residue = fit_lines(flicker(rng, 1000), 0.004 * t, 10)[1]
        s = SimpleNamespace(samples=1000, dt=1.0, frequency=0.004, reading=np.zeros(11), noise=noise, residue=residue)
        scores.append(score_of(line, [s]))
    assert 0.8 < np.sqrt(np.mean(np.square(scores))) < 1.2 and steadiness(s) < 0.3
    white = dataclasses.replace(noise, flicker=0.0, white=1.0)
    assert steadiness(SimpleNamespace(**{**vars(s), "noise": white})) == pytest.approx(1.0, abs=0.02)


def test_why_two_drifts_are_not_told_apart_is_where_they_show():
    """Zeros of the recordings were said to come near one another between the harmonics, where they do not show."""
    within = RecordEffect("zero_drift", 9.0, 1e-7, 1e-8, {}), RecordEffect("thermal_drift", 8.9, 1e-7, 1e-8, {"tau": 3.0})
    means = zeros_of([SimpleNamespace(peak_to_peak=4e-5)], 23.0, [1e-6], [1e-7])
    for (effect, rival), why in ((within, "between the harmonics"), (means, "mean level as a whole")):
        ties = ties_of(SimpleNamespace(adopted=((effect, [rival]),), reached=SimpleNamespace(steps=[])))
        assert why in ties["thermal_drift"]["why"] and ties["zero_drift"]["why"] == ""


@pytest.mark.parametrize("shape", [lambda u: u, np.sqrt], ids=["straight", "root"])
def test_drifts_of_the_same_size_in_long_and_short_records_are_each_their_own(shape):
    size = 4e-7
    runs = records(lambda t: size * shape(t / t[-1]))
    best = scored(runs)[0]
    assert best.name == "zero_drift" and best.shapes == {"own": True} and best.z > 20
    for column in best.columns:
        assert column[-1] == pytest.approx(size, rel=0.2)
    plain = records()
    for clean, bare, drifted in zip(remove_record_effect(runs, best, "displacement"), plain, runs, strict=True):
        left, there = (np.std(x.channels["displacement"] - bare.channels["displacement"]) for x in (clean, drifted))
        assert left < 0.25 * there
    assert all(
        s.drift == pytest.approx(size, rel=0.25) for s in spectra_of(remove_record_effect(runs, best, "displacement"), BENCH)
    )


def test_drifts_at_rates_of_their_own_show_in_the_longer_records_alone():
    """Short records show none of a rate; drifts that differ are no hum."""
    rates = iter((1.1e-6, -0.7e-6, 1.4e-6, -1.2e-6, 0.9e-6, 1e-6, -1e-6))
    runs = records(lambda t: next(rates) * (t + 0.6 * t**2 / t[-1]), frequencies=(8.0, 13.0, 17.7, 24.2, 196.0, 240.0, 400.0))
    best = scored(runs)[0]
    assert best.name == "zero_drift" and best.shapes == {"own": True} and best.z > 20


def test_hum_beside_the_drift_does_not_pass_for_it():
    runs = records(lambda t: 2e-7 * np.sin(2 * np.pi * 50.01 * t + 1), frequencies=(10.0, 23.0, 80.0, 120.0))
    best = scored(runs)[0]
    assert best.name == "mains_hum" and best.shapes["f"] == 50.0


def test_a_strong_drift_of_a_short_record_is_no_data_problem():
    """Periods that differ by what one straight drift and its root explain repeat; a decaying swing does not."""
    for beside, wrong in (
        (lambda t: 1.2e-6 * np.sqrt(t / t[-1]), False),
        (lambda t: 2e-6 * np.exp(-t / t[-1] * 2.7) * np.cos(9.3 * t / t[-1]), True),
    ):
        runs = records(beside)
        found = data_problem(runs, spectra_of(runs, BENCH), "displacement")
        assert (found is not None) is wrong


@pytest.mark.parametrize("drifting", [(0, 1, 2, 3), (1,)], ids=["all", "one"])
def test_a_large_drift_of_every_record_is_named_and_that_of_one_spoils_it(monkeypatch, drifting):
    """Four microns of forty: what every record shows is taken out, named and told; one that drifts alone is to be recorded again."""
    plain, moved = records(), records(lambda t: 4e-6 * t / t[-1])
    runs = [moved[k] if k in drifting else plain[k] for k in range(4)]
    monkeypatch.setattr(module.Task, "fit", lambda self, *a, **k: None)

    def examined(begun):
        left = [np.ptp(r.channels["displacement"][::500]) for r in begun.task.recordings]  # one sample a period
        assert max(left) < 1e-6
        return Diagnosis("attributed", f"{begun.adopted[0][0].name} was left out.")

    monkeypatch.setattr(module, "_examined", examined)
    found = module.diagnose(runs, BENCH)
    assert "the reading drifts by 3 um through" in found.message and "let it warm up" in found.message
    assert found.verdict == ("data_problem" if len(drifting) == 1 else "attributed")
    assert found.message.startswith("zero_drift was left out. As recorded") == (len(drifting) == 4)


def test_check_recordings_lose_what_was_adopted_and_no_more():
    size = 4e-7
    runs = records(lambda t: size * t / t[-1])
    (check,) = records(lambda t: size * t / t[-1], (77.0,), seed=9)
    (bare,) = records(frequencies=(77.0,), seed=9)
    drift = scored(runs)[0]
    (clean,) = remove_from_checks([check], [drift], BENCH)
    left = clean.channels["displacement"] - bare.channels["displacement"]
    assert np.abs(left).max() < 0.15 * size
    (same,) = remove_from_checks([check], [], BENCH)
    assert np.array_equal(same.channels["displacement"], check.channels["displacement"])
    aperiodic = Recording(
        check.time,
        {"current": np.linspace(0, 1, len(check.time)) ** 2, "displacement": check.channels["displacement"]},
        name="ramp",
    )
    assert remove_from_checks([aperiodic], [drift], BENCH) == [aperiodic]


def test_check_recordings_lose_heat_at_the_amplitude_that_the_others_show():
    runs = records(lambda t: 8e-6 * 0.32 * 0.3 * (1 - np.exp(-t / 0.3)))
    heat = next(e for e in scored(runs) if e.name == "thermal_drift")
    (check,) = records(lambda t: 8e-6 * 0.32 * 0.3 * (1 - np.exp(-t / 0.3)), (7.0,), seed=9)
    (bare,) = records(frequencies=(7.0,), seed=9)
    before, after = (
        np.std(x.channels["displacement"] - bare.channels["displacement"])
        for x in (check, *remove_from_checks([check], [heat], BENCH))
    )
    assert after < 0.2 * before


def test_a_drift_of_one_record_alone_is_taken_out_of_it_and_told():
    """It was called hum: any wave of its length bends like a hum between the harmonics of that record."""
    runs = records()
    t = runs[1].time
    for extra in (5e-7 * t / t[-1], 6e-7 * np.exp(-8 * t / t[-1])):
        spoilt = [*runs[:1], Recording(t, {**runs[1].channels, "displacement": runs[1].channels["displacement"] + extra}, name="50 Hz"), *runs[2:]]
        assert next(e for e in scored(spoilt) if e.name == "mains_hum").z < 8
        cleaned, told = drifts_of_one(spoilt, spectra_of(spoilt, BENCH), BENCH)
        assert len(told) == 1 and told[0].startswith("50 Hz alone drifts")
        assert [bool(r.origin.get("zero")) for r in cleaned] == [False, True, False, False]  # where it settles is not known
        left = cleaned[1].channels["displacement"] - runs[1].channels["displacement"]
        assert np.std(left) < 0.25 * np.std(extra)


@pytest.mark.parametrize("frequencies", [FREQUENCIES, (10.0, 300.0, 400.0, 500.0)], ids=["shown by most", "shown by the long one"])
@pytest.mark.parametrize("rate", [pytest.param(0.0, marks=pytest.mark.long), 1e-6, 2e-5])
def test_what_the_others_may_share_is_no_drift_of_one(frequencies, rate):
    runs = records(lambda t: rate * t, frequencies)
    assert drifts_of_one(runs, spectra_of(runs, BENCH), BENCH) == (runs, [])


@pytest.mark.parametrize("drifting", [pytest.param(False, marks=pytest.mark.long), True], ids=["none drifts", "one drifts"])
def test_hum_in_short_records_is_no_drift_of_one(drifting):
    """A short record sees less than a period of the hum, which the longer ones show whole."""
    phases = np.random.default_rng(2).uniform(0, 2 * np.pi, 9).tolist()
    frequencies = (51.0, 228.0, 328.0, 10.0, 122.0, 14.0, 7.0, 65.0, 25.0)
    runs = records(lambda t: 2e-7 * np.sin(2 * np.pi * 50.01 * t + phases.pop()), frequencies)
    if drifting:
        t, reading = runs[-1].time, runs[-1].channels["displacement"]
        runs[-1] = Recording(t, {**runs[-1].channels, "displacement": reading + 8e-7 * t / t[-1]}, name="25 Hz")
    spectra = spectra_of(runs, BENCH)
    assert drifting or lone_drifts(spectra)  # without a look at the hum
    _, told = drifts_of_one(runs, spectra, BENCH)
    assert [said.split(" alone drifts")[0] for said in told] == ["25 Hz"] * drifting
