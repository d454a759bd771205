"""What a report shows of a fit, as plain arrays: taken from the result once, kept beside it, drawn again at any time.

Residuals are model less measurement.
"""

import json
from pathlib import Path

import numpy as np

from ..inversion import mass_errors
from ..joint import data_residual, fields
from ..spectra import evaluate_lines, hum_part
from ..uncertainty import visited_cells
from .residuals import autocorrelation, by_field_and_rate, by_phase, traces

SHOWN = 12  # recordings whose loops are drawn
INSIDE = 3  # recordings whose internal signals are drawn
BINS = 200  # points a drawn loop
STEP = 500  # simulated samples a period


def of_fit(result, inside: bool = True, chosen=None) -> dict:
    """The evidence of a `FitResult`; `inside`: simulate H, I_1 and M too; `chosen`: whose loops, found if None."""
    problem = result.problem
    misfit = model_misfit(result)
    spectra = problem.spectra
    chosen = chosen_recordings(result) if chosen is None else chosen
    applied = [
        np.asarray(result.actuator.coil.applied_field(s.drive_at(np.arange(s.samples) * s.dt * s.frequency))) for s in spectra
    ]
    residuals = [evaluate_lines(m, _phases(s)) - s.residue for m, s in zip(misfit, spectra, strict=True)]
    noise = np.array([max(s.noise_rms, 1e-300) for s in spectra])
    scaled = [r / n for r, n in zip(residuals, noise, strict=True)]
    found = {
        "drive": result.bench.drive,
        "name": np.array([_short(r.file) for r in result.recordings]),
        "frequency": np.array([s.frequency for s in spectra]),
        "periods": np.array([s.periods for s in spectra]),
        "noise": noise,
        "chi2": np.array([r.chi2_per_sample for r in result.recordings]),
        "rms": np.array([np.sqrt(np.mean(r**2)) for r in residuals]),
        "stroke": np.array([s.peak_to_peak for s in spectra]),
        "chosen": np.array(chosen),
        "loops": {str(k): _loop(spectra[k], misfit[k]) for k in chosen},
        "zoom": {str(k): _zoom(spectra[k], misfit[k]) for k in _extremes(result)[:2]},
        "lines": _lines(result, misfit),
        "trace": traces(spectra, scaled),
        "against": by_field_and_rate(spectra, applied, scaled),
        "autocorrelation": autocorrelation(spectra, residuals),
        "plane": _plane(result),
        "bounds": json.dumps({n: [float(i.low), float(i.high)] for n, (_, i) in result.actuator.parameters().items()}),
    }
    if inside:
        found["inside"] = _inside(result, sorted(_extremes(result)[:INSIDE]))
    return found


def model_misfit(result) -> np.ndarray:
    """Fourier coefficients of model less measurement, (recordings, harmonics + 1), unit of the reading; without the mean of a
    recording that has a zero of its own, and hum that stands on a line."""
    problem = result.problem
    residual = data_residual(problem, result.solution.z)
    R, H = problem.target.lines.shape
    misfit = residual[: R * H].reshape(R, H).astype(complex)
    misfit[:, 1:] += 1j * residual[R * H :].reshape(R, H - 1)
    misfit[[s.zero > 0 for s in problem.spectra], 0] = 0.0
    deviations = np.asarray(problem.target.deviations)
    misfit *= np.where(np.isfinite(deviations), deviations, 0.0)
    return misfit - np.stack([hum_part(m, s) for m, s in zip(misfit, problem.spectra, strict=True)])


def chosen_recordings(result, count: int = SHOWN) -> list[int]:
    """Which recordings are drawn: all, or the worst half of `count` and the rest spread over frequency; by frequency."""
    frequency = np.array([s.frequency for s in result.problem.spectra])
    order = np.argsort(frequency, kind="stable")
    if len(order) <= count:
        return [int(k) for k in order]
    worst = set(np.argsort([-r.chi2_per_sample for r in result.recordings], kind="stable")[: count // 2].tolist())
    others = [int(k) for k in order if k not in worst]
    spread = {others[i] for i in np.linspace(0, len(others) - 1, count - len(worst)).astype(int)}
    return [int(k) for k in order if k in worst | spread]


def _extremes(result) -> list[int]:
    """The worst recording, the fastest, the slowest, one between; each once."""
    frequency = np.array([s.frequency for s in result.problem.spectra])
    order = np.argsort(frequency, kind="stable")
    worst = int(np.argmax([r.chi2_per_sample for r in result.recordings]))
    return list(dict.fromkeys([worst, int(order[-1]), int(order[0]), int(order[len(order) // 2])]))


def _phases(s) -> np.ndarray:
    """Cycles of each sample."""
    return np.arange(s.samples) * s.dt * s.frequency


def _short(file: str) -> str:
    return Path(str(file)).name


def _loop(s, misfit) -> dict:
    """One period at bin centres: drive, measured (mean of the periods), model, and the noise of that mean."""
    phases, residue, count = by_phase(s, s.residue, BINS)
    lines = evaluate_lines(s.reading, phases)
    return {
        "phase": phases, "drive": s.drive_at(phases), "measured": lines + residue, "model": lines + evaluate_lines(misfit, phases),
        "noise": s.noise_rms / np.sqrt(np.maximum(count, 1)),
    }  # fmt: skip


def _zoom(s, misfit, width: float = 0.06) -> dict:
    """Raw samples about the largest misfit of the last period, s from the record's start."""
    phases = np.arange(1000) / 1000
    smooth = evaluate_lines(misfit, phases)
    centre = s.periods - 1 + phases[int(np.argmax(np.abs(smooth)))]
    all_phases = _phases(s)
    near = np.flatnonzero(np.abs(all_phases - centre) < width)
    near = near[:: max(1, len(near) // 250)]
    reading, repeating = evaluate_lines(s.reading, all_phases[near]), evaluate_lines(misfit, all_phases[near])
    return {"time": near * s.dt, "measured": reading + s.residue[near], "model": reading + repeating, "misfit": repeating}


def _lines(result, misfit) -> dict:
    """Amplitudes of the harmonics: measured, misfit, rms of their noise; and what lies between for the chosen few."""
    problem = result.problem
    deviations = np.asarray(problem.target.deviations)
    amplitude = np.full(deviations.shape[1], 2.0)
    amplitude[0] = 1.0
    parts = np.where(np.arange(deviations.shape[1]) == 0, 1.0, np.sqrt(2.0))
    between = {}
    for k in _extremes(result)[:3]:
        s = problem.spectra[k]
        order = s.between_f / s.frequency
        keep = order < deviations.shape[1]
        edges = np.linspace(0, deviations.shape[1], 161)
        place = np.clip(np.digitize(order[keep], edges) - 1, 0, 159)
        number = np.bincount(place, minlength=160)
        power = np.bincount(place, s.between_power[keep], minlength=160)[number > 0] / number[number > 0]
        between[str(k)] = {"order": (0.5 * (edges[1:] + edges[:-1]))[number > 0], "amplitude": 2 * np.sqrt(power / s.samples)}
    return {
        "measured": amplitude * np.abs(np.asarray(problem.target.lines)),
        "misfit": amplitude * np.abs(misfit),
        "floor": np.where(np.isfinite(deviations), amplitude * parts * deviations, np.nan),
        "between": between,
    }


def _plane(result) -> dict:
    """Masses of the plane without its once-switching edge, their standard errors, which cells a recording switches."""
    hysteresis = result.actuator.hysteresis
    inner = slice(1, -1)
    try:
        errors = mass_errors(result)[inner, inner]
    except np.linalg.LinAlgError:  # a stalled fit may have no covariance
        errors = np.full((hysteresis.cells - 2,) * 2, np.nan)
    return {
        "masses": np.asarray(hysteresis.masses)[inner, inner], "errors": errors,
        "seen": visited_cells(result.actuator, result.problem.spectra)[inner, inner], "levels": np.asarray(hysteresis.levels)[inner],
    }  # fmt: skip


def steady(actuator, s):
    """`Signals` of one settled period on the recording's drive; the same compiled program for all plain drives."""
    from magjax.extrema import nesting
    from magjax.simulate import simulate

    power = np.abs(s.drive[1:]) ** 2
    highest = int(np.flatnonzero(power > 1e-3 * power.max()).max()) + 1
    count = STEP * int(min(8, 2 ** np.ceil(np.log2(max(highest / 1.5, 1)))))
    drive = s.drive_at(np.arange(count) / count)
    history = actuator.hysteresis.history.shape[0] // 2
    corners = max(8, int(4 * np.ceil((nesting(np.tile(drive, 2)) + history) / 4)))
    return simulate(actuator, drive, 1 / (s.frequency * count), periodic=True, corners=corners)


def _inside(result, chosen) -> dict:
    """H, I_1 = (H - H_bias)/c0 and M over one period of the chosen recordings, thinned."""
    actuator, problem = result.actuator, result.problem
    # what the source does to the current, and a stack's polarization, are not in the march
    plain = actuator.piezo is None and not any(e.block == "source" for e in actuator.effects)
    marched = fields(problem, result.solution.z) if plain else None
    found = {}
    for k in chosen:
        if plain:
            current, H, M = marched[k]
        else:
            signals = steady(actuator, problem.spectra[k])
            current, H, M = (np.asarray(x) for x in (signals.current, signals.field, signals.magnetization))
        thin = slice(None, None, max(1, len(H) // BINS))
        applied = np.asarray(actuator.coil.applied_field(current))
        rows = found[str(k)] = {
            "phase": np.arange(len(H[thin])) / len(H[thin]),
            "H": H[thin],
            "M": M[thin],
            "applied": applied[thin],
        }
        if actuator.coil.drive == "current":
            rows["current"] = current[thin]
            rows["I_1"] = (rows["H"] - float(actuator.coil.H_bias)) / float(actuator.coil.c0)
    return found


def of_checks(before, after, recordings, bench, own_zeros: bool = False, cleaned=()) -> dict:
    """Measured and predicted periods of check recordings, before and after a repair; `own_zeros`: which leaves each its level;
    `cleaned`: them without what the repair finds between the harmonics, if it does."""
    from ..check import HARMONICS, all_lines, predicted_periods

    found = {}
    periodic = [k for k, r in enumerate(recordings) if r.frequency() is not None]
    spectra = [all_lines(recordings[k], bench) for k in periodic]
    if not spectra:
        return found
    clean = [all_lines(cleaned[k], bench) for k in periodic] if cleaned else spectra  # more lines may tell where less is beside them
    first = predicted_periods(before, spectra)
    lines = {"before": first, "after": first if after is before and not cleaned else predicted_periods(after, clean)}
    for at, (k, s, own) in enumerate(zip(periodic, spectra, clean, strict=True)):
        recording = recordings[k]
        bins = BINS if len(own.reading) <= HARMONICS + 1 else 4 * BINS  # loops of many lines turn often
        phases, residue, count = by_phase(s, s.residue, bins)
        recorded = evaluate_lines(s.reading, phases) + residue
        hum = hum_part(own.reading - lines["after"][at][: len(own.reading)], own)
        measured = evaluate_lines(own.reading - hum, phases) + by_phase(own, own.residue, bins)[1]
        entry = {
            "name": np.array(_short(recording.origin.get("file", recording.name))), "frequency": np.array(s.frequency), "phase": phases,
            "drive": s.drive_at(phases), "measured": measured, "recorded": recorded, "noise": own.noise_rms / np.sqrt(np.maximum(count, 1)),
        }  # fmt: skip
        for key in ("before", "after"):
            predicted = evaluate_lines(lines[key][at], phases)
            levelled = bench.output == "flux_density" or (own_zeros and key == "after")
            entry[key] = predicted - (predicted.mean() - measured.mean()) * levelled
        found[str(k)] = entry
    return found


def of_offender(shown) -> dict:
    """The signal of a file that cannot be used, whole and about the place, thinned; `shown`: as a `RecordingError` holds it."""
    values, first, length = np.asarray(shown["values"], float), shown["first"], shown["length"]
    time = np.arange(len(values), dtype=float) if shown.get("time") is None else np.asarray(shown["time"], float)
    found = {key: np.array(shown.get(key) or "") for key in ("name", "channel", "unit")}
    found |= {"timed": np.array(shown.get("time") is not None), "span": time[[first, min(first + length, len(time)) - 1]] - time[0]}
    near = np.arange(max(0, first - 2 * length), min(len(values), first + 3 * length))
    for key, picked in (("whole", np.arange(len(values))), ("near", near)):
        thin = picked[:: max(1, len(picked) // 1500)]
        found[key] = {"time": time[thin] - time[0], "values": values[thin]}
    return found


READINGS = ("displacement", "flux_density", "magnetization", "polarization")


def of_recordings(recordings) -> dict:
    """The readings as recorded, one row a period, for recordings that no model may judge yet."""
    found = {}
    for k, recording in enumerate(recordings[:SHOWN]):
        output = next((c for c in READINGS if c in recording.channels), None)
        if output is None:
            continue
        values = np.asarray(recording.channels[output], float)
        blocks = recording.repeats(output)
        drive = recording.repeats(recording.drive)
        if not len(blocks):
            blocks, drive = values[None], np.asarray(recording.channels[recording.drive], float)[None]
        pick = [0, *range(max(1, len(blocks) - 2), len(blocks))]  # the first and the last two
        thin = slice(None, None, max(1, blocks.shape[1] // BINS))
        found[str(k)] = {
            "name": np.array(_short(recording.name)), "frequency": np.array(recording.frequency() or 0.0), "drive": drive[pick][:, thin],
            "reading": blocks[pick][:, thin], "number": np.array(pick) + 1, "output": np.array(output),
        }  # fmt: skip
    return found
