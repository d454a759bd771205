"""What is asked for next: instruments for rivals that stand in them, else the sine that rivals cannot both follow."""

from types import SimpleNamespace

import numpy as np
import pytest

from fitting import experiments
from fitting.experiments import CALIBRATION, PICK_UP, SHUNT, channels_for, instrument_request, menu, next_experiment, separations
from magjax.bench import load_bench


def spectrum(f, A, offset):
    lines = np.array([offset, -0.5j * A, 0.0])
    at = lambda phases: offset + A * np.sin(2 * np.pi * phases)
    return SimpleNamespace(frequency=float(f), drive=lines, drive_at=at)


def rival(name, block):
    return SimpleNamespace(name=name, candidate=SimpleNamespace(block=block), result=name)


SPECTRA = [spectrum(10, 0.8, 0.1), spectrum(200, 0.4, -0.2)]


def test_instruments_are_asked_for_by_themselves():
    assert channels_for(("source", "coil")) == [SHUNT]
    assert channels_for(("sensor", "mechanics")) == [CALIBRATION]
    assert channels_for(("sensor", "coil"), "flux_density") == [PICK_UP]  # no rod that moves is on that bench
    assert channels_for(("source", "sensor", "mechanics")) == [SHUNT, CALIBRATION]
    assert channels_for(("mechanics", "magnetostriction")) == []
    assert "pick-up" in channels_for(("coil", "hysteresis"))[0] and "range" in channels_for(("sensor", "magnetostriction"))[0]
    asked = instrument_request(("source", "sensor"))
    assert (
        asked["drive"] is None and "shunt" in asked["text"] and "calibration" in asked["text"] and "a mass added" in asked["text"]
    )


def test_the_menu_stays_within_what_was_visited():
    drives = menu(SPECTRA, load_bench("aa-050h"))
    assert sorted({f for f, _, _ in drives}) == pytest.approx([5.0, np.sqrt(2000), 200.0, 300.0, 400.0])
    assert all(offset + A <= 0.9 and offset - A >= -0.7001 for _, A, offset in drives)


def test_a_drive_about_zero_is_asked_for_without_the_rest_that_counts_leave():
    """A page had asked for an offset of 4.69e-10 A."""
    swings = [SimpleNamespace(frequency=10.0, drive_at=lambda phases: 0.8 * np.sin(2 * np.pi * phases) + 4.7e-10)]
    assert {offset for *_, offset in menu(swings, load_bench("aa-050h"))} == {0.0}
    swings = [SimpleNamespace(frequency=10.0, drive_at=lambda phases: 0.5 * np.sin(2 * np.pi * phases) + 0.01)]
    assert all(offset == pytest.approx(0.01) for *_, offset in menu(swings, load_bench("aa-050h")))


def known(r, J=None, C=None):
    r = np.asarray(r, float)
    return r, np.zeros((*r.shape, 1)) if J is None else J, np.eye(1) if C is None else C


def test_what_a_fit_could_take_up_separates_nothing(monkeypatch):
    made = {
        "a": known([[0.0, 0.0], [0.0, 0.0]]),
        "b": known([[30.0, 0.0], [0.0, 5.0]], np.array([[[1.0], [0.0]]] * 2), np.array([[1e6]])),
    }
    monkeypatch.setattr(experiments, "_predicted", lambda result, drives, spectra: made[result])
    rivals = [SimpleNamespace(result="a"), SimpleNamespace(result="b")]
    apart = separations(rivals, [(10, 1, 0), (20, 1, 0)], SPECTRA)
    assert apart.shape == (2, 1) and apart[0, 0] < 0.1 and apart[1, 0] == pytest.approx(5.0)


@pytest.mark.parametrize(("gap", "sine"), [(8.0, True), (0.5, False)])
def test_a_sine_is_proposed_only_where_it_decides(monkeypatch, gap, sine):
    drives = menu(SPECTRA, load_bench("aa-050h"))
    rows = {"sensor_lag": np.zeros((len(drives), 2)), "delta_e": np.zeros((len(drives), 2))}
    rows["delta_e"][3] = gap
    monkeypatch.setattr(experiments, "_predicted", lambda result, drives, spectra: known(rows[result]))
    found = next_experiment([rival("sensor_lag", "sensor"), rival("delta_e", "mechanics")], SPECTRA, load_bench("aa-050h"))
    assert found["channels"] == [CALIBRATION] and found["text"].startswith("record a calibration")
    assert (found["drive"] is not None) == sine and bool(found["separates"]) == sine
    if sine:
        assert "; or a sine of 44.7 Hz, amplitude 0.4 A, offset 0.1 A, four settled periods: separates" in found["text"]
        assert found["drive"]["frequency_Hz"] == pytest.approx(drives[3][0]) and found["separates"][0][:2] == [
            "sensor_lag",
            "delta_e",
        ]
    else:
        assert "no sine within the limits" in found["text"]


def test_text_and_table_give_the_same_probabilities(monkeypatch):
    """Of three rivals the nearest two need not be the first two."""
    apart = np.full((10, 3), 8.0)
    apart[:, 2] = 3.2  # of the second from the third
    monkeypatch.setattr(experiments, "separations", lambda *a: apart)
    rivals = [rival("duffing_stiffness", "mechanics"), rival("delta_e", "mechanics"), rival("creep", "mechanics")]
    found = next_experiment(rivals, SPECTRA, load_bench("aa-050h"))
    assert [row[:2] for row in found["separates"]][2] == ["delta_e", "creep"] and len(found["separates"]) == 3
    assert found["separates"][0][2] == 0.99 and found["separates"][2][2] == pytest.approx(0.945, abs=1e-3)
    for a, b, p in found["separates"]:
        assert f"{a} from {b} with probability {p:.2f}" in found["text"]
