"""Check recordings: prediction against reading on data that took no part in the fit."""

import numpy as np

from magjax.extrema import nesting
from magjax.plausibility import si_unit
from magjax.simulate import simulate
from magjax.words import sized

from .model import Predictor, predicted_lines
from .spectra import evaluate_lines, hum_part, reduce_recording

SAMPLES, HARMONICS = 500, 40  # of a prediction: points a period, lines
UNTIL = (1e-4, 60)  # periods simulated: until two differ by less, of their peak to peak, and at most
WIDE = 160  # lines of one of a drive of many lines, such as a multisine, whose reading has more than HARMONICS
MANY, TELLS = 5, 0.9  # order of a drive's last line from which it may be one, and share of what is between the lines that more must leave


def all_lines(recording, bench):
    """A periodic recording's `Spectrum`: with WIDE lines of the reading where its drive has many and HARMONICS leave some of them."""
    spectrum = reduce_recording(recording, bench.drive, bench.output, columns=bench.columns)
    if np.flatnonzero(spectrum.drive)[-1:].sum() < MANY:
        return spectrum
    more = reduce_recording(recording, bench.drive, bench.output, WIDE, bench.columns)
    return more if len(more.reading) > len(spectrum.reading) and more.noise_rms < TELLS * spectrum.noise_rms else spectrum


def predicted_periods(actuator, spectra) -> list:
    """Fourier coefficients of the settled reading on the drives of some spectra (`all_lines`), as many of each as it has lines."""
    found = {}
    for many in (False, True):
        some = [k for k, s in enumerate(spectra) if (len(s.reading) > HARMONICS + 1) == many]
        if not some:
            continue
        chosen = [spectra[k] for k in some]
        turns = max(nesting(np.tile(s.drive_at(np.arange(800) / 800), 2)) for s in chosen)
        wide, corners = WIDE if many else HARMONICS, int(4 * np.ceil(turns / 4))
        predictor = Predictor.build(chosen, SAMPLES, wide, 0, corners, apart=False, until=UNTIL)
        lines = np.concatenate([np.asarray(predicted_lines(part, actuator))[: len(places)] for part, places in predictor.batches()])
        found |= dict(zip(some, lines[np.asarray(predictor.index)], strict=True))
    return [found[k] for k in range(len(spectra))]


def predictions(actuator, recordings, bench) -> list:
    """(predicted, measured, noise rms) over the samples of each recording. Periodic drives settle first; others start at rest."""
    found = {}
    for k, recording in enumerate(recordings):
        if recording.frequency() is None:
            drive = recording.channels[bench.drive]
            signals = simulate(actuator, drive, recording.dt, outside="saturate")  # told by `beyond_plane`
            found[k] = np.asarray(signals.reading), recording.channels[bench.output], None
    periodic = [k for k in range(len(recordings)) if k not in found]
    spectra = [all_lines(recordings[k], bench) for k in periodic]
    for k, s, lines in zip(periodic, spectra, predicted_periods(actuator, spectra), strict=True):
        phases = np.arange(s.samples) * s.dt * s.frequency
        hum = evaluate_lines(hum_part(s.reading - lines[: len(s.reading)], s), phases)
        found[k] = evaluate_lines(lines, phases), recordings[k].channels[bench.output][: s.samples] - hum, s.noise_rms
    rows = [(recordings[k], *found[k]) for k in range(len(recordings))]
    return [(predicted, _levelled(np.asarray(y, float), predicted, r, bench), noise) for r, predicted, y, noise in rows]


def prediction(actuator, recording, bench) -> tuple:
    """(predicted, measured, noise rms) over the samples of one recording (`predictions`)."""
    return predictions(actuator, [recording], bench)[0]


def _levelled(measured, predicted, recording, bench):
    """The reading, at the prediction's mean where its own says nothing: an integrated emf, a zero of this recording's own."""
    free = bench.output == "flux_density" and recording.frequency() is not None
    return measured - measured.mean() + predicted.mean() if free or recording.origin.get("zero") else measured


def beyond_plane(actuator, recording, bench) -> float:
    """How far a recording's drive leads the applied field out of the fitted plane, as a share of the plane: 0 where it does not.

    Out there every relay of the model is saturated: nothing is known of them.
    """
    field = np.asarray(actuator.coil.applied_field(np.asarray(recording.channels[bench.drive], float)))
    low, high = float(actuator.hysteresis.low), float(actuator.hysteresis.high)
    return max(low - float(field.min()), float(field.max()) - high, 0.0) / (high - low)


def check_errors(before, after, recordings, bench, cleaned=None) -> list[dict]:
    """rms error on each check recording before and after the repair; `cleaned`: what the repaired model is held against,
    the recordings without the drift, heat or hum that it names."""
    unit, cleaned = si_unit(bench.output), recordings if cleaned is None else cleaned
    first = predictions(before, recordings, bench)
    last = first if after is before and cleaned is recordings else predictions(after, cleaned, bench)
    rows = []
    for recording, *found in zip(recordings, first, last, strict=True):
        errors = [float(np.sqrt(np.mean((predicted - measured) ** 2))) for predicted, measured, _ in found]
        noise = found[1][2]
        rows.append(
            {"file": recording.origin.get("file", recording.name), "channel": bench.output, "unit": unit,
             "rms_before": errors[0], "rms_after": errors[1], "noise_rms": noise if noise is not None else 0.0,
             "beyond_plane": beyond_plane(after, recording, bench)}
        )  # fmt: skip
    return rows


def foretold_text(rows) -> str:
    """What a repair does to the errors of check recordings, rows of `check_errors`, a sentence; "" without any."""
    each = (f"{r['file'].rsplit('/', 1)[-1]}: {sized(r['unit'], r['rms_before'], r['rms_after'])}" for r in rows)
    return f" On check recordings: {'; '.join(each)}." if rows else ""
