"""From recordings and a bench to a `Problem`: spectra, noise, the plane, the density basis, the start."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from magjax.errors import ConfigurationError, RecordingError
from magjax.extrema import nesting
from magjax.param import in_numpy
from magjax.recording import NO_ANSWER, follows_nothing

from .density import Stiffness, cell_basis, hat_basis, held_basis
from .joint import Problem
from .model import Layout, Predictor, Target, make_start_actuator, on_device
from .spectra import HARMONICS, gain_rows, line_deviations, reduce_recording, with_noise
from .starts import equation_error_start, scan_loss
from .transients import unsettled_starts
from .uncertainty import NO_PRIOR

START_WEIGHTS = (1e2, 1e2, 1e2, 1e2)  # one a family of penalties; the last where there is a reversible part
PLANE_MARGIN = 0.01
EDDY_EFFECT = "effects.eddy_currents.k"
SCANNED = ("coil.k_eddy", "piezo.chi")  # benches differ by decades: a scan finds where they begin
REACH = 30.0  # times the bench's value, or that part of it: as far as a positive parameter may go


@dataclasses.dataclass(frozen=True)
class Choices:
    """How a fit is set up. `level`: cells along the plane, the same for all densities, so that these share programs; `knots`:
    hats in s and r, None for one unknown a cell, of `cells` along the plane (a divisor of the level; None: all of them);
    `coarse`, `fine`: samples a period for the Jacobian and for the residual; `periods`: simulated, the last used, of all
    recordings or of each."""

    level: int = 120
    knots: tuple[int, int] | None = (18, 13)
    cells: int | None = None
    coarse: int = 125
    fine: int = 500
    periods: int | tuple[int, ...] = 3
    harmonics: int = HARMONICS
    max_jacobians: int = 30
    without: tuple[str, ...] = ()  # effects that a diagnosis does not ask for: their instrument was measured
    only: tuple[str, ...] = ()  # the effects that it does ask for, where these are named
    rest: str = "auto"  # start memory: "negative", "demagnetized" about the drive's zero, "virgin": about no field, "positive", or tried in turn
    touching: bool = False  # start from loops whose M may turn its sign wherever the strain comes near zero
    stiffness: Stiffness | None = None  # of a density with steps; None: one weight a family of differences, by evidence


def spectra_of(recordings, bench, harmonics: int = HARMONICS):
    """Each recording reduced to lines, decaying starts taken out; raises `RecordingError` where one is not periodic."""
    for recording in recordings:
        if recording.frequency() is None:
            raise RecordingError(
                f"{recording.name}: the {recording.drive} does not repeat; a fit needs periodic drives (one whole period at least), "
                "give this recording with --check instead"
            )
        if follows_nothing(recording, bench.output):
            raise RecordingError(f"{recording.name}: {NO_ANSWER.format(channel=bench.output, drive=recording.drive)}")

    def reduced(recording):
        return reduce_recording(recording, bench.drive, bench.output, harmonics, bench.columns)

    spectra = [reduced(r) for r in recordings]
    if bench.output == "displacement" and "mechanics.f0" in bench.constants:
        starts = unsettled_starts(spectra, float(bench.constants["mechanics.f0"]))
        for k, start in enumerate(starts):
            if start is not None:
                spectra[k] = dataclasses.replace(reduced(_less(recordings[k], bench.output, start)), start=start)
    return with_noise(spectra)


def _less(recording, output, start):
    """The recording without a decaying start."""
    reading = np.array(recording.channels[output], float)
    reading[: len(start)] -= start
    return dataclasses.replace(recording, channels={**recording.channels, output: reading})


def applied_range(spectra, actuator):
    """Lowest and highest applied field over all recordings, A/m."""
    phases = np.arange(500) / 500
    coil = in_numpy(actuator.coil)
    fields = [coil.applied_field(s.drive_at(phases)) for s in spectra]
    return min(f.min() for f in fields), max(f.max() for f in fields)


def effect_parameters(actuator) -> tuple[str, ...]:
    """Names of the free parameters of an actuator's effects, none for None: what `fit` frees with `extra`."""
    return tuple(f"effects.{e.name}.{p}" for e in (actuator.effects if actuator is not None else ()) for p in e.free_parameters())


def free_parameters(bench, actuator, extra=()):
    """Names of the scalar parameters to fit: the bench's, and those of the effects."""
    known = actuator.parameters()
    names = [n for n in bench.free if n != "hysteresis.masses"] + list(extra)
    for name in names:
        if name not in known:
            raise ConfigurationError(f'fit.free names "{name}", which this bench does not have; it has {", ".join(known)}')
    return tuple(dict.fromkeys(names))


def masses_held(bench) -> bool:
    """Whether the bench leaves the Preisach masses out of what is fitted."""
    return "hysteresis.masses" not in bench.free


def with_held_masses(choices: Choices, bench, actuator) -> Choices:
    """The choices that are left where the masses are held; raises where nothing says what they are."""
    if not masses_held(bench):
        return choices
    if actuator is None:
        raise ConfigurationError(
            "fit.free leaves hysteresis.masses out, and nothing says what they are; give the fitted folder that holds them (--model), "
            "or name hysteresis.masses in fit.free"
        )
    return dataclasses.replace(choices, knots=None, rest="held")


def build_problem(spectra, actuator, bench, names, choices: Choices, start=None) -> tuple[Problem, np.ndarray]:
    """The problem and its starting vector. `start`: a basis, and the density unknowns on it and bottom to go on from, left aside
    where they are of another plane; else equation error."""
    if np.min(choices.periods) < 2:
        raise ConfigurationError(f"periods = {choices.periods}: a steady state takes two at least, of which the last is read")
    low, high = applied_range(spectra, actuator)
    margin = PLANE_MARGIN * (high - low)
    held = masses_held(bench)
    total = float(actuator.strained.M_s) if actuator.strained is not None else _total_from(spectra, bench)
    known_field = bench.drive == "field"
    if held:
        basis = held_basis(actuator.hysteresis, total)
        if low < basis.low or high > basis.high:
            raise ConfigurationError(
                f"the masses are held on a plane of {basis.low:.5g} .. {basis.high:.5g} {bench.terms.unit} and the recordings reach {low:.5g} .. {high:.5g}; "
                "name hysteresis.masses in fit.free, or leave out the recordings beyond"
            )
    elif choices.knots is None:
        basis = cell_basis(low - margin, high + margin, total, choices.level, choices.cells)
    else:
        crowd = 1.7 if bench.drive == "field" else 1.0
        level = 2 * choices.level if known_field else choices.level
        basis = hat_basis(low - margin, high + margin, total, level, *choices.knots, crowd, bench.drive != "current")
    start = None if start is None else _led_over(*start, basis)
    rest = field_of_rest(choices.rest, actuator, basis.low, basis.high)
    harmonics = min(choices.harmonics, max(len(s.reading) for s in spectra) - 1)
    full = [line_deviations(s, s.noise) for s in spectra]
    deviations = [_padded(d, harmonics, np.inf) for d in full]
    memories = len(spectra) if actuator.output == "displacement" else 0
    starter = actuator  # its coil holds all of the eddy loss, for the equation error
    for loss in {"coil.k_eddy", EDDY_EFFECT} & set(names) if bench.drive == "field" and start is None and not held else ():
        # field-driven benches differ by decades: find the scale first
        found = scan_loss(basis, spectra, full, actuator, "coil.k_eddy", np.geomspace(1e-3, 30.0, 19))
        actuator, starter = actuator.replace({loss: found}), actuator.replace({"coil.k_eddy": found})
    if "piezo.chi" in names and start is None and not held:
        steepest = float(actuator.piezo.V_m) * max(s.peak_to_peak for s in spectra) / ((high - low) * _full_scale(actuator))
        found = scan_loss(basis, spectra, full, actuator, "piezo.chi", steepest * np.linspace(0.2, 1.1, 10))
        actuator = starter = actuator.replace({"piezo.chi": found})
    if held:
        start = np.asarray([(actuator.hysteresis.offset - actuator.hysteresis.masses.sum()) / total])
    elif start is None:
        x, bottom, _ = equation_error_start(basis, spectra, full, starter, rest=rest, touching=choices.touching)
        start = np.append(x, bottom)
    known = actuator.parameters()
    values = [float(known[n][0]) for n in names]
    infos = [known[n][1] for n in names]
    log = [i.low >= 0 and v > 0 and (i.null is None or i.shape) for i, v in zip(infos, values, strict=True)]
    scales = [i.scale for i in infos]
    lows, highs = _bounds(names, values, infos, log, bench)
    about = [i.null if i.prior and n not in bench.priors else v for n, v, i in zip(names, values, infos, strict=True)]
    layout = Layout.build(basis, names, about, scales, lows, highs, log, memories)
    corners = max(4, max(nesting(np.tile(s.drive_at(np.arange(400) / 400), 2)) for s in spectra))
    corners += len(bench.start) // 2 + 1 if isinstance(bench.start, tuple) else 0
    corners = int(4 * np.ceil(corners / 4))
    periods = choices.periods if np.size(choices.periods) in (1, len(spectra)) else min(choices.periods)  # some of the recordings alone
    predictors = tuple(Predictor.build(spectra, n, harmonics, periods, corners) for n in period_samples(choices, bench))
    lines = np.stack([_padded(s.reading, harmonics, 0.0) for s in spectra])
    deviations = np.stack(deviations)
    if actuator.output == "flux_density":  # an integrated emf has no mean
        deviations[:, 0] = np.inf
    priors = np.asarray([_prior(bench, *row) for row in zip(names, values, log, infos, strict=True)] + [1.0] * memories)
    rows, shares = gain_rows(spectra, deviations)
    target = Target(
        *(on_device(x) for x in (lines, deviations, START_WEIGHTS[: len(basis.penalties)], priors, 1e-3, rows, shares))
    )  # fmt: skip
    template = actuator if held else make_start_actuator(actuator, basis, rest)
    if isinstance(bench.start, tuple) and not held:
        template = template.remembering(bench.start)
    stiffness = choices.stiffness if choices.stiffness is not None and choices.stiffness.fits(basis) else None
    if stiffness is not None:
        target = eqx.tree_at(lambda t: t.weights, target, jnp.ones(len(basis.penalties)))
    problem = Problem(layout, template, predictors, target, tuple(spectra), basis, bench.quasistatic, stiffness)
    return problem, np.concatenate([start, [layout.coordinate(n, v) for n, v in zip(names, values, strict=True)], np.zeros(memories)])


def _led_over(basis, found, new):
    """Density unknowns and bottom on a new basis; None where it is of another plane."""
    x = new.taking(found[: basis.unknowns], basis)
    return None if x is None else np.append(x, found[basis.unknowns])


def _padded(values, harmonics: int, missing: float):
    """Values of lines 0..harmonics; `missing` where a recording of few samples a period has none."""
    return np.append(values[: harmonics + 1], np.full(max(harmonics + 1 - len(values), 0), missing))


def period_samples(choices: Choices, bench) -> tuple[int, int]:
    """Samples a period for the Jacobian and for the residual."""
    finer = 2 if bench.drive == "field" else 1  # a narrow loop under a strong field turns within a few samples
    return finer * choices.coarse, finer * choices.fine


def field_of_rest(name: str, actuator, low: float, high: float) -> float:
    """The field about which a start memory of that name was demagnetized, A/m, on a plane from `low` to `high`."""
    zero = float(in_numpy(actuator.coil).applied_field(0.0))
    return float(np.clip({"demagnetized": zero, "virgin": 0.0, "positive": high}.get(name, low), low, high))


def _bounds(names, values, infos, log, bench):
    """Lowest and highest value of each free parameter, SI, infinite where there is none.

    The shapes of an effect keep their bounds; its amplitude is free in sign, so that one that is not there comes out as nothing, but for a
    `firm` one.
    A positive parameter of the plain chain stays within `REACH` of the bench's value: beyond (R_eddy without end, xi at nothing)
    its logarithm has no slope left, and a fit that a missing effect has led there never comes back.
    """
    nominal = bench.actuator().parameters()
    lows, highs = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    for k, (name, value, info) in enumerate(zip(names, values, infos, strict=True)):
        if name.startswith("effects."):
            lows[k], highs[k] = info.low if info.shape or info.firm else -np.inf, info.high
        elif log[k] and name not in SCANNED:
            about = float(nominal[name][0])
            given_nearby = about > 0 and abs(np.log(value / about)) < np.log(REACH) + 1e-9
            about = about if given_nearby else value
            lows[k], highs[k] = about / REACH, about * REACH
    return lows, highs


def _prior(bench, name, value, is_log, info):
    """1 / standard deviation in the optimiser's coordinate: the bench's about the start, the effect's own about its null, or a very
    wide one that keeps it finite."""
    if name in bench.priors:
        deviation = bench.priors[name]
        return value / deviation if is_log else info.scale / deviation
    if info.shape:  # a shape means nothing while its effect is small: hold it within about a factor of three
        return 1.0 if is_log else 0.5
    if info.prior:
        return info.scale / info.prior
    return NO_PRIOR


def _full_scale(actuator) -> float:
    """The reading of a stack at V_m, SI."""
    return float(actuator.piezo.P_m if actuator.output == "polarization" else actuator.piezo.stroke)


def _total_from(spectra, bench):
    """Scale of the masses where no M_s is stated: from the largest reading."""
    largest = max(s.peak_to_peak for s in spectra)
    return largest / (4e-7 * np.pi) if bench.output == "flux_density" else largest
