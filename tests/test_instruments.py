"""What a converter and an uncertain scale leave: stated in the bench file, taken into the misfit."""

import dataclasses

import numpy as np
import pytest

from fitting.spectra import gain_rows, line_deviations, reduce_recording, with_noise
from magjax.bench import load_bench
from magjax.errors import ConfigurationError
from magjax.recording import Recording


def recording(gain=1.0, frequency=10.0, seed=0, emf=False):
    rng = np.random.default_rng(seed)
    n = 800
    t = np.arange(n) / (200 * frequency)
    H = 200 * np.cos(2 * np.pi * frequency * t) + 5
    B = gain * (0.4 * np.cos(2 * np.pi * frequency * t - 0.1) + 0.02 * np.cos(6 * np.pi * frequency * t))
    return Recording(t, {"field": H, "flux_density": B + 1e-4 * rng.standard_normal(n)}, {}, {}, f"{frequency} Hz")


def test_uncertain_scales_are_whitened_as_their_covariance_says():
    columns = {"flux_density": {"gain_accuracy": 0.03}}
    spectra = with_noise(
        [reduce_recording(recording(1.0, f, k), "field", "flux_density", 10, columns) for k, f in enumerate((10.0, 20.0, 50.0))]
    )
    deviations = np.stack([line_deviations(s, s.noise) for s in spectra])
    deviations[:, 0] = np.inf
    rows, share = gain_rows(spectra, deviations)
    # C = I + U G U' on the readings' directions: W C W must be the identity
    n = len(spectra)
    sizes = np.array([np.sqrt(np.sum(np.abs(s.reading / d) ** 2)) for s, d in zip(spectra, deviations, strict=True)])
    C = np.eye(n) + 0.03**2 * sizes[:, None] * (np.eye(n) - 1 / n) * sizes
    W = np.eye(n) - share
    assert np.abs(W @ C @ W - np.eye(n)).max() < 1e-9
    # a common scale is the bench's word and stays fully weighted; scales that differ hardly count
    common, different = W @ sizes, W @ (sizes * [1.0, -1.0, 0.0])
    assert np.linalg.norm(common) == pytest.approx(np.linalg.norm(sizes), rel=1e-3)
    assert np.linalg.norm(different) < 0.01 * np.linalg.norm(common)
    exact = [dataclasses.replace(s, gain_accuracy=0.0) for s in spectra]
    assert np.abs(gain_rows(exact, deviations)[1]).max() < 1e-12


def test_bits_widen_the_low_orders_and_drop_the_converters_own_lines():
    plain = reduce_recording(recording(), "field", "flux_density", 30)
    assert plain.systematic is None
    columns = {"field": {"bits": 8}, "flux_density": {"bits": 8}}
    coarse = reduce_recording(recording(), "field", "flux_density", 30, columns)
    assert np.all(coarse.systematic > 0) and coarse.systematic[25] < 0.2 * coarse.systematic[2]
    finer = reduce_recording(recording(), "field", "flux_density", 30, {"field": {"bits": 12}, "flux_density": {"bits": 12}})
    assert finer.systematic[3] == pytest.approx(coarse.systematic[3] / 16)
    dirty = recording()
    dirty.channels["field"] += 0.1 * np.cos(2 * np.pi * 70.0 * dirty.time)  # far below half a count of 8 bits
    assert np.count_nonzero(np.abs(reduce_recording(dirty, "field", "flux_density", 30).drive) > 0) == 3
    assert np.count_nonzero(np.abs(reduce_recording(dirty, "field", "flux_density", 30, columns).drive) > 0) == 2


@pytest.mark.parametrize(
    ("line", "words"), [("bits = 0", "bits = 0"), ("gain_accuracy = 3", "gain_accuracy = 3"), ('bits = "8"', "bits = '8'")]
)
def test_wrong_instrument_keys_are_told(tmp_path, line, words):
    path = tmp_path / "b.toml"
    path.write_text(f"[coil]\nk_eddy = 0.1\n[columns.field]\n{line}\n")
    with pytest.raises(ConfigurationError, match=words):
        load_bench(str(path))
