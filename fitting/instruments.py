"""Instruments that were recorded by themselves: the amplifier by command and shunt, the sensor by a calibration.

A linear filter behind the strain acts the same in the sensor as in the rod, and a lag before the coil much like a loss in
it: from command and reading alone they are told apart by their form at best, and a filter of second order from the rod's
resonance not at all. What is measured here leaves the search: the measured current drives the coil, the sensor's filter
is part of the base, held by its calibration's errors.
"""

import dataclasses
import itertools

import numpy as np

from magjax.effects import SensorLag, TransportDelay
from magjax.errors import RecordingError
from magjax.instruments import SENSOR_LAWS, fit_laws, judge_laws, judge_source

from .check import check_errors, foretold_text
from .fit import fit_or_stop as fit
from .joint import data_residual
from .memories import rests_of
from .setup import build_problem, effect_parameters, free_parameters, spectra_of
from .spectra import line_deviations, reduce_recording, with_noise

SECOND_ORDER = 0.05  # order2 from which a sensor's filter is one of second order
RINGING = 0.5  # damping below which a filter is no instrument's
NOT_LINEAR = {
    "duffing_stiffness",
    "delta_e",
    "coulomb_friction",
    "backlash",
    "sensor_nonlinearity",
    "stress_feedback",
}  # between rod and sensor
STRONG = 1e-3  # of the strongest line: weaker ones tell no gain
FINEST = 1e-5  # relative; no gain is taken for better known
START_GRID = {
    "mechanics.f0": (1.0, 2.0, 4.0, 8.0, 16.0),
    "mechanics.xi": (1.0, 0.2),
    "coil.R_eddy": (1.0, 4.0),
}  # of the bench's word
SETTLES = {"source": ("amplifier_lag", "amplifier_clipping"), "sensor": ("sensor_lag", "transport_delay")}


@dataclasses.dataclass(frozen=True)
class Instrument:
    """One instrument's own verdict: `block`; `verdict` as of `judge_laws`; `name` of an effect of the catalogue or None;
    its `parameters`: name -> (value, standard error), SI; `text`."""

    block: str
    verdict: str
    name: str | None
    parameters: dict
    text: str

    @property
    def settled(self) -> bool:
        """Whether effects of its block need not be asked for: the measured current drives the model, a law meets the calibration."""
        return self.block == "source" or self.verdict == "follows" or self.name is not None

    def effect(self):
        """The effect with the measured values, None where there is none."""
        kinds = {"sensor_lag": SensorLag, "transport_delay": TransportDelay}
        return kinds[self.name](**{k: v for k, (v, _) in self.parameters.items()}) if self.name in kinds else None


def has_shunt(recording) -> bool:
    """Whether a recording holds the command beside a measured current."""
    command, current = (recording.channels.get(c) for c in ("command", "current"))
    if command is None or current is None or recording.origin.get("metadata", {}).get("current") == "command":
        return False
    return not np.array_equal(command, current)


def on_command(recordings) -> list:
    """The recordings as one without a shunt has them: the command in place of the measured current."""
    rows = []
    for r in recordings:
        channels = {k: v for k, v in r.channels.items() if k != "command"}
        rows.append(dataclasses.replace(r, channels={**channels, "current": r.channels["command"]}) if has_shunt(r) else r)
    return rows


def line_gains(recordings, drive: str, output: str, columns=None):
    """(w in rad/s, output over drive, standard error of its parts) at every strong line of the drive, all recordings."""
    rows = []
    for s in with_noise([reduce_recording(r, drive, output, columns=columns) for r in recordings]):
        size = np.abs(s.drive[: len(s.reading)])
        deviation = np.hypot(
            line_deviations(s, s.noise), s.drive_noise / np.sqrt(2 * s.samples) * np.abs(s.reading[1]) / size[1:].max()
        )
        for h in np.flatnonzero(size > STRONG * size[1:].max()):
            if h > 0:
                gain = s.reading[h] / s.drive[h]
                rows.append((2 * np.pi * h * s.frequency, gain, max(deviation[h] / size[h], FINEST * abs(gain))))
    return tuple(np.array(c) for c in zip(*rows, strict=True))


def measured_source(recordings, bench) -> Instrument | None:
    """The amplifier by command and measured current; None where no recording holds both.

    Raises `RecordingError` where some recordings do and others do not.
    """
    having = [has_shunt(r) for r in recordings]
    if not any(having):
        return None
    if not all(having):
        bare, full = recordings[having.index(False)], recordings[having.index(True)]
        raise RecordingError(
            f"{bare.name}: holds no measured current beside the command, {full.name} does; give recordings with the shunt only, "
            "or leave the column command_A out of all"
        )
    gains = line_gains(recordings, "command", "current", bench.columns)
    verdict, best, _ = judge_source(*gains)
    tau, error = best.parameters["tau"]
    size = f"{1e6 * tau:.4g} ± {1e6 * error:.2g} us"
    if verdict == "follows":
        return Instrument("source", verdict, None, {}, "The measured current follows its command.")
    if verdict == "amplifier_lag" and tau > 0:
        order = "second" if "order2" in best.parameters else "first"
        text = f"The measured current lags its command by {size} as an amplifier of {order} order does: amplifier_lag (source)."
        return Instrument("source", verdict, "amplifier_lag", best.parameters, text)
    what = (
        f"a lag of {size}, a delay or a first-order one"
        if verdict in ("delay", "group")
        else "something else than a first-order lag"
    )
    text = f"Between command and measured current stands {what}; the measured current drives the model."
    return Instrument("source", verdict, None, {}, text)


def measured_sensor(calibrations, bench) -> Instrument | None:
    """The sensor by its reading over a known displacement; None without calibrations.

    Raises `RecordingError` where a calibration does not repeat or holds too few frequencies.
    """
    calibrations = list(calibrations)
    for r in calibrations:
        if r.frequency() is None:
            raise RecordingError(f"{r.name}: the reference does not repeat; calibrate with periodic motion, whole periods of it")
    if not calibrations:
        return None
    w, gain, error = line_gains(calibrations, "reference", bench.output, bench.columns)
    if len(np.unique(np.round(w, 6))) < 3:
        raise RecordingError(
            f"{calibrations[0].name}: the calibration holds {len(w)} frequencies; a filter needs three or more, up to the fastest drive"
        )
    verdict, best, _ = judge_laws(fit_laws(w, gain, error, SENSOR_LAWS))
    reach = f"up to {w.max() / 2 / np.pi:.4g} Hz"
    scale = (
        ""
        if abs(best.gain - 1) < 0.002
        else f" Its scale is {best.gain:.5g} of what the bench file says; mend it in [columns.{bench.output}]."
    )
    if verdict == "follows":
        return Instrument("sensor", verdict, None, {}, f"By its calibration the sensor follows {reach}.{scale}")
    if verdict == "unknown":
        text = (
            f"The calibration {reach} is met by no filter of first or second order and no delay; the sensor stays unknown.{scale}"
        )
        return Instrument("sensor", verdict, None, {}, text)
    words = ", ".join(f"{k} = {v:.5g} ± {e:.2g}{' s' if k == 'tau' else ''}" for k, (v, e) in best.parameters.items())
    text = f"By its calibration the sensor has {filter_words(**{k: v for k, (v, _) in best.parameters.items()})} ({words}): {best.law} (sensor).{scale}"
    return Instrument("sensor", verdict, best.law, best.parameters, text)


def filter_words(tau: float, order2: float | None = None) -> str:
    """A sensor's filter in words: "a second-order filter of 400 Hz, damping 0.71"; without `order2` a delay."""
    if order2 is None:
        return f"a delay of {1e6 * tau:.4g} us"
    if order2 < 0.02:
        return f"a first-order filter of {1 / (2 * np.pi * tau):.4g} Hz"
    f, xi = filter_as_mode(tau, order2)
    return f"a second-order filter of {f:.4g} Hz, damping {xi:.2g}"


def filter_as_mode(tau: float, order2: float) -> tuple[float, float]:
    """(Hz, damping ratio) of 1/(1 + s tau + order2 (s tau)^2)."""
    return float(1 / (2 * np.pi * tau * np.sqrt(order2))), float(0.5 / np.sqrt(order2))


def mode_as_filter(f0: float, xi: float) -> tuple[float, float]:
    """(tau in s, order2) of the filter that acts as a mode of f0 (Hz) and damping ratio xi."""
    return float(xi / (np.pi * f0)), float(0.25 / xi**2)


def exchange(result, bench, form: str | None = None) -> tuple[str, bool] | None:
    """Whether the sensor's fitted filter and the rod's resonance could change places: (a sentence, whether they likely have).

    Linear filters commute: 1/(1 + s tau + order2 (s tau)^2) in the sensor behind a mode f0, xi reads the same as the mode's
    filter in the sensor behind a rod that resonates as the sensor's did. None where something tells them apart: a stated
    prior of f0, xi or the filter, a first-order filter, or mechanics that are not linear. A "sensor" that rings (damping
    below one half, as no instrument's filter does) is likely the rod. `form`: an effect that only makes up for the form of
    the others' laws.
    """
    held = {e.name for e in result.actuator.effects} - {form}
    names = {e.name for e in result.estimates if e.free}
    mode, filtered = ("mechanics.f0", "mechanics.xi"), ("effects.sensor_lag.tau", "effects.sensor_lag.order2")
    if not {*mode, *filtered} <= names or {*mode, *filtered} & set(bench.priors) or held & NOT_LINEAR:
        return None
    (f0, xi), (tau, order2) = ([result.estimate(n).value for n in pair] for pair in (mode, filtered))
    if order2 < SECOND_ORDER or tau <= 0:
        return None
    f, damping = filter_as_mode(tau, order2)
    text = (
        f"The sensor's filter ({f:.4g} Hz, damping {damping:.2g}) and the rod's resonance ({f0:.4g} Hz, damping {xi:.2g}) can change places "
        "without any change of the reading"
    )
    if damping < RINGING:
        return (
            f"{text}, and no instrument's filter rings like that: the rod may be what rings. By these channels instruments and actuator are not told apart.",
            True,
        )
    return f"{text}: f0 and xi are the rod's only if this is the right way round.", False


def known_instruments(recordings, calibrations, bench) -> tuple[Instrument, ...]:
    """What the recordings say about the instruments by themselves; empty without shunt and calibration."""
    found = (measured_source(recordings, bench) if bench.drive == "current" else None, measured_sensor(calibrations, bench))
    return tuple(i for i in found if i is not None)


def without_command(recordings) -> list:
    """The recordings with the measured current as their drive, the command put away."""
    return [dataclasses.replace(r, channels={k: v for k, v in r.channels.items() if k != "command"}) for r in recordings]


def nearest_start(recordings, bench, actuator, choices):
    """The actuator with the start of R_eddy, f0 and xi from which the recordings are met best.

    A bench file's constants may have been fitted through the very filter that is known now, as the founding paper's may.
    """
    spectra = spectra_of(recordings, bench, choices.harmonics)
    names = free_parameters(bench, actuator)
    grid = {n: [float(actuator.parameters()[n][0]) * f for f in factors] for n, factors in START_GRID.items() if n in names}
    rest = dataclasses.replace(choices, rest=rests_of(bench, choices)[0][0])
    best = (np.inf, actuator)
    for values in itertools.product(*grid.values()):
        trial = actuator.replace(dict(zip(grid, values, strict=True)))
        problem, z = build_problem(spectra, trial, bench, names, rest)
        misfit = data_residual(problem, z)
        chi2 = float(misfit @ misfit)
        if chi2 < best[0]:
            best = (chi2, trial)
    return best[1]


def diagnose_beyond(known, diagnose, recordings, bench, check, actuator, choices, progress):
    """`diagnose` with the measured instruments in their place, and what they do to the plain model told beside its verdict."""
    say = progress or (lambda *a: None)
    plain_start, start = actuator, bench.actuator() if actuator is None else actuator
    filters = [(i, i.effect()) for i in known if i.effect() is not None]
    priors = dict(bench.priors)
    for instrument, effect in filters:
        start = start.with_effect(effect)
        priors |= {f"effects.{effect.name}.{k}": e for k, (_, e) in instrument.parameters.items()}
    without = tuple(n for i in known if i.settled for n in SETTLES[i.block])
    inner = dataclasses.replace(choices, without=(*choices.without, *without))
    stated = dataclasses.replace(bench, priors=priors)
    if filters:
        say("where to start beside the sensor's filter", 0, None)
        start = nearest_start(without_command(recordings), stated, start, inner)
    found = diagnose(without_command(recordings), stated, check=without_command(check), actuator=start if start.effects else None,
                     choices=inner, progress=progress)  # fmt: skip
    texts = " ".join(i.text for i in known if (i.block, i.verdict) != ("source", "follows"))
    if found.verdict == "data_problem" or not any(i.name for i in known):
        return dataclasses.replace(found, message=f"{found.message} {texts}".strip())
    say("the plain model, for comparison", 0, None)
    final = found.repaired or found.base
    plain = fit(on_command(recordings), bench, actuator=plain_start, extra=effect_parameters(plain_start),
                choices=dataclasses.replace(choices, rest=final.choices.rest), progress=progress, refine=False)  # fmt: skip
    return _joined(known, found, plain, final, on_command(check), without_command(check), bench, texts)


def _joined(known, found, plain, final, check_plain, check, bench, texts):
    """The inner verdict with the instruments named beside it and the plain model as the base."""
    units = {"tau": "s", "order2": "1"}
    shifts = {
        e.name: [e.value, final.estimate(e.name).value] for e in plain.estimates if e.free and not e.name.startswith("effects.")
    }
    rows = [
        {
            "name": i.name, "block": i.block, "confidence": 0.99, "shifts": shifts,
            "parameters": {k: {"value": v, "stderr": e, "unit": units[k]} for k, (v, e) in i.parameters.items()},
        }
        for i in known if i.name
    ]  # fmt: skip
    checks = []
    for before, after in zip(
        check_errors(plain.actuator, plain.actuator, check_plain, bench),
        check_errors(final.actuator, final.actuator, check, bench),
        strict=True,
    ):
        checks.append({**after, "rms_before": before["rms_before"]})
    verdict = "attributed" if found.verdict in ("nothing_missing", "absorbed") else found.verdict
    constants = ", ".join(
        f"{e.name} = {e.value:.4g} ± {e.stderr:.2g}{'' if e.unit == '1' else ' ' + e.unit}" for e in map(final.estimate, shifts)
    )
    named = " and ".join(r["name"] for r in rows)
    text = (
        f"{texts} With {named} in place chi2/N falls from {plain.chi2_per_sample:.3g} to {final.chi2_per_sample:.2f}; {constants}."
    )
    text += foretold_text(checks)
    nothing = found.verdict == "nothing_missing" and found.ended_after is None
    rest = "Beyond that nothing is missing." if nothing else f"Beyond that: {found.message}"
    return dataclasses.replace(
        found,
        verdict=verdict,
        message=f"{text} {rest}",
        effects=(*rows, *({**e, "shifts": shifts} for e in found.effects)),
        base=plain,
        repaired=final,
        check=tuple(checks),
        cleaned_checks=(),
    )
