"""Check recordings: prediction against reading on data that took no part in the fit."""

import numpy as np

from magjax.extrema import nesting
from magjax.plausibility import si_unit
from magjax.simulate import simulate

from .model import Predictor, predicted_lines
from .spectra import evaluate_lines, reduce_recording


def prediction(actuator, recording, bench):
    """(predicted, measured, noise rms) over the recording's samples. Periodic drives settle first; others start at rest."""
    measured = np.asarray(recording.channels[bench.output], float)
    if recording.frequency() is None:
        signals = simulate(actuator, recording.channels[bench.drive], recording.dt, outside="saturate")  # told by `beyond_plane`
        predicted = np.asarray(signals.reading)
        return predicted, _levelled(measured, predicted, recording, bench), None
    s = reduce_recording(recording, bench.drive, bench.output, columns=bench.columns)
    corners = int(4 * np.ceil(nesting(np.tile(s.drive_at(np.arange(800) / 800), 2)) / 4))
    lines = np.asarray(predicted_lines(Predictor.build([s], 500, 40, 4, corners), actuator))[0]
    phases = np.arange(s.samples) * s.dt * s.frequency
    predicted = evaluate_lines(lines, phases)
    return predicted, _levelled(measured[: s.samples], predicted, recording, bench), s.noise_rms


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
    unit = si_unit(bench.output)
    rows = []
    for recording, clean in zip(recordings, recordings if cleaned is None else cleaned, strict=True):
        errors = []
        noise = None
        for actuator, reading in ((before, recording), (after, clean)):
            predicted, measured, noise = prediction(actuator, reading, bench)
            errors.append(float(np.sqrt(np.mean((predicted - measured) ** 2))))
        rows.append(
            {"file": recording.origin.get("file", recording.name), "channel": bench.output, "unit": unit,
             "rms_before": errors[0], "rms_after": errors[1], "noise_rms": noise if noise is not None else 0.0,
             "beyond_plane": beyond_plane(after, recording, bench)}
        )  # fmt: skip
    return rows
