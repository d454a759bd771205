"""Hum where it falls on harmonics of the drive: it repeats like the loop, and only the other recordings tell them apart."""

import dataclasses

import numpy as np
import pytest

from fitting.check import all_lines, check_errors
from fitting.demo import concealed_actuator, record
from fitting.diagnose import diagnose
from fitting.fit import fit
from fitting.on_lines import hum_score
from fitting.record_level import hum_between, hum_is_seen, remove_from_checks, remove_record_effect
from fitting.report.evidence import of_checks
from fitting.setup import Choices, spectra_of
from fitting.spectra import line_deviations
from magjax.bench import load_bench
from magjax.effects import CATALOGUE
from magjax.recording import Recording
from magjax.simulate import simulate

BENCH = load_bench("aa-050h")
DRIVES = ((10, 0.8, 0.1), (25, 0.5, -0.2), (50, 0.6, 0.1), (100, 0.5, -0.1), (170, 0.7, 0.1), (230, 0.5, -0.2))
HUM = 9e-8


def recorded(hum=0.0, drives=DRIVES, only=None):
    """Recordings with hum at 50 Hz, in that of one frequency `only` where it is given."""
    rng = np.random.default_rng(5)
    truth, rows = concealed_actuator(BENCH), []
    for f, amplitude, offset in drives:
        row = record(truth, f, amplitude, offset, rng, f"{f} Hz")
        wave = (hum if only in (None, f) else 0.0) * np.sin(2 * np.pi * 50.0 * row.time + rng.uniform(0, 2 * np.pi))
        rows.append(dataclasses.replace(row, channels={**row.channels, "displacement": row.channels["displacement"] + wave}))
    return rows


@pytest.mark.long
def test_nothing_scores_on_harmonics_of_the_mains_without_hum():
    base = fit(recorded(), BENCH, refine=False)
    z, tones = hum_score(base.problem, base.refined)
    assert z < 5 and len(tones) == 3


@pytest.mark.long
def test_hum_scores_on_the_harmonics_that_it_falls_on():
    base = fit(recorded(HUM), BENCH, refine=False)
    z, tones = hum_score(base.problem, base.refined)
    assert z > 15 and tones[0] == (50.0, pytest.approx(HUM, rel=0.3))


@pytest.mark.long
def test_what_one_recording_shows_alone_is_no_hum():
    """It would have the same size in all of them."""
    base = fit(recorded(2 * HUM, only=25), BENCH, refine=False)
    assert hum_score(base.problem, base.refined) == (0.0, ())


@pytest.mark.parametrize(("fifth", "orders"), [(0.25, (1, 2, 3, 5)), (0.0, (1, 2, 3))], ids=["a fifth multiple", "none"])
def test_hum_has_the_multiples_that_show(fifth, orders):
    """A fifth multiple was left in the reading: on the tenth harmonic of a 30 Hz loop it was physics that no effect explains."""
    rng, rows = np.random.default_rng(6), []
    for row in recorded(drives=((17, 0.8, 0.1), (29, 0.6, 0.1), (30, 0.5, -0.2), (70, 0.5, 0.1))):
        phases = rng.uniform(0, 2 * np.pi, 2)
        wave = 5 * HUM * (np.sin(120 * np.pi * row.time + phases[0]) + fifth * np.sin(600 * np.pi * row.time + phases[1]))
        rows.append(dataclasses.replace(row, channels={**row.channels, "displacement": row.channels["displacement"] + wave}))
    spectra = spectra_of(rows, BENCH)
    found = hum_between(spectra)
    assert found.shapes["f"] == 60.0 and [f / 60 for f, _ in found.shapes["tones"]] == list(orders)
    assert found.shapes["tones"][-1][1] == pytest.approx(5 * fifth * HUM, abs=2e-8)
    cleaned = spectra_of(remove_record_effect(rows, found, "displacement"), BENCH)
    assert all(s.noise_rms < 1.3 * np.sqrt(np.mean(q.residue**2)) for s, q in zip(cleaned, spectra_of(recorded(drives=DRIVES[:1]), BENCH), strict=False))
    again = remove_from_checks(rows[:1], [found], BENCH)[0]
    taken = rows[0].channels["displacement"] - again.channels["displacement"]
    assert 2 * abs(np.mean(taken * np.exp(-600j * np.pi * rows[0].time))) == pytest.approx(5 * fifth * HUM, abs=1e-8)
    deviations = line_deviations(cleaned[2], cleaned[2].noise)  # of the loop of 30 Hz
    assert (deviations[10] > 3 * deviations[9]) == (fifth > 0)


def test_hum_must_show_between_the_harmonics_where_it_can():
    tones = ((50.0, HUM), (100.0, 0.0), (150.0, 0.0))
    off, on = (30, 0.8, 0.1), (50, 0.6, 0.1)
    assert not hum_is_seen(spectra_of(recorded(drives=(off, on)), BENCH), tones)
    assert hum_is_seen(spectra_of(recorded(HUM, (off, on)), BENCH), tones)
    assert hum_is_seen(spectra_of(recorded(drives=(on,)), BENCH), tones)  # it cannot show


@pytest.mark.parametrize("hum", [0.0, 1.5e-7])
def test_harmonics_of_the_drive_beyond_those_that_are_read_are_no_hum(hum):
    """A loop with steep flanks at 1 Hz has a line at 50 Hz of its own, 19 nm beside noise of 60; one that stands out is hum."""
    rng = np.random.default_rng(2)
    t, h = np.arange(5000) / 1000, np.arange(1, 200)
    y = 1e-5 * (h**-1.6) @ np.cos(2 * np.pi * h[:, None] * t + rng.uniform(0, 2 * np.pi, (len(h), 1)))
    y = y + hum * np.sin(2 * np.pi * 50 * t) + 6e-8 * rng.standard_normal(len(t))
    recording = Recording(t, {"current": np.cos(2 * np.pi * t), "displacement": y})
    found = hum_between(spectra_of([recording], BENCH))
    assert found.z > 30 and abs(found.amplitude - hum) < 0.2 * hum if hum else found.z < 4


def test_a_check_recording_is_drawn_as_its_number_says():
    """Title and strip of one figure: 25 nm beside a sine of 170 nm, which was the hum on a line."""
    truth = concealed_actuator(BENCH)
    row = record(truth, 10.0, 0.6, 0.1, np.random.default_rng(3), "10 Hz")
    wave = 5 * HUM * np.sin(2 * np.pi * 50.0 * row.time + 1.1)
    raw = dataclasses.replace(row, channels={**row.channels, "displacement": row.channels["displacement"] + wave})
    clean = dataclasses.replace(raw, origin={**row.origin, "hum": ((50.0, 5 * HUM),)})
    numbers = check_errors(truth, truth, [raw], BENCH, [clean])[0]
    entry = of_checks(truth, truth, [raw], BENCH, cleaned=[clean])["0"]
    before, after = (np.sqrt(np.mean((entry[k] - entry[m]) ** 2)) for k, m in (("before", "recorded"), ("after", "measured")))
    assert before == pytest.approx(numbers["rms_before"], rel=0.1) and before > 2e-7
    assert after < numbers["rms_after"] < 1.2 * numbers["noise_rms"]


def test_a_multisine_is_drawn_though_hum_had_hidden_its_many_lines():
    """Beside a hum of 2 um the lines beyond the fortieth tell nothing: without it the reading has 161 of them."""
    rng, phase, truth = np.random.default_rng(4), np.arange(4 * 1600) / 1600, BENCH.actuator()
    current = 0.05 + sum(0.09 * np.sin(2 * np.pi * (k * phase + rng.random())) for k in (3, 7, 11, 13, 17, 19, 23, 27, 31, 33, 37))
    reading = np.tile(np.asarray(simulate(truth, current[:1600], 1 / (1600 * 7.0), periodic=True).displacement), 4)
    reading += 4e-8 * rng.standard_normal(len(phase))
    wave = 2e-6 * np.sin(2 * np.pi * 50.0 * phase / 7.0)
    raw, clean = (
        Recording(phase / 7.0, {"current": current, "displacement": y}, {}, origin, "multisine")
        for y, origin in ((reading + wave, {}), (reading, {"hum": ((50.0, 2e-6),)}))
    )
    assert len(all_lines(raw, BENCH).reading) < len(all_lines(clean, BENCH).reading)
    entry = of_checks(truth, truth, [raw], BENCH, cleaned=[clean])["0"]
    assert np.sqrt(np.mean((entry["after"] - entry["measured"]) ** 2)) < 8e-8
    assert entry["noise"].max() < 8e-8  # of the reading that is drawn


@pytest.mark.parametrize(("other", "left"), [(0.0, 0.0), (4.0, 3.0)], ids=["hum alone", "more than hum"])
def test_hum_on_a_line_of_a_check_recording_is_no_error(other, left):
    """A check recording of 10 Hz was missed by ten times its noise for a hum of 50 Hz, of which its own reading tells no phase."""
    bench, truth = BENCH, concealed_actuator(BENCH)
    row = record(truth, 10.0, 0.6, 0.1, np.random.default_rng(3), "10 Hz")
    plain = check_errors(truth, truth, [row], bench)[0]["rms_after"]
    wave = HUM * (1 + other) * np.sin(2 * np.pi * 50.0 * row.time + 1.1)
    channels = {**row.channels, "displacement": row.channels["displacement"] + wave}
    spoilt = dataclasses.replace(row, channels=channels)
    known = dataclasses.replace(spoilt, origin={**row.origin, "hum": ((50.0, HUM * (1 + other - left)), (100.0, 0.0))})
    as_is, less = (check_errors(truth, truth, [r], bench)[0]["rms_after"] for r in (spoilt, known))
    assert as_is == pytest.approx(np.hypot(plain, HUM * (1 + other) / np.sqrt(2)), rel=0.05)
    assert less == pytest.approx(np.hypot(plain, HUM * left / np.sqrt(2)), rel=0.05)


def test_hum_on_a_line_is_no_residual_of_a_fit():
    rows = [dataclasses.replace(r, origin={**r.origin, "hum": ((50.0, HUM), (100.0, 0.0))}) for r in recorded(HUM, DRIVES[:3])]
    found = fit(rows, BENCH, refine=False)
    assert all(r.residual_rms < 1.3 * r.noise_rms for r in found.recordings[::2])  # 10 and 50 Hz stand on it


@pytest.mark.long
def test_hum_that_falls_on_harmonics_is_named_and_no_physics():
    asked = {"quartic_magnetostriction", "sensor_lag", "creep", "second_eddy_path"}  # all of it: the blind suites
    others = tuple(e.name for e in CATALOGUE if e.name not in asked)
    found = diagnose(recorded(HUM), BENCH, choices=Choices(fine=250, without=others))
    assert found.verdict == "attributed" and [e["name"] for e in found.effects] == ["mains_hum"]
    assert found.repaired.chi2_per_sample < 1.1 < 0.5 * found.base.chi2_per_sample
    sizes = [p["value"] for p in found.effects[0]["parameters"].values()]
    assert any(v == pytest.approx(HUM, rel=0.25) for v in sizes)
    assert "falls from" in found.message
