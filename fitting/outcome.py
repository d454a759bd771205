"""The outcome of a fit: the misfit of each recording, and what there is to say of it in words."""

from pathlib import Path

import numpy as np

from magjax.plausibility import si_unit
from magjax.recording import stray_samples
from magjax.words import sized

from .floors import swapped
from .memories import RESTS, STATES
from .result import RecordingFit
from .spectra import hum_part

LOST, AT_BOUND = 1e5, 100.0  # chi2/N from which a fit has led nowhere, and one with a parameter at its bound
SLOW, MOST_STROKE = 0.3, 1.1  # of f0, below which a rod moves as its strain does; of the rod's reach, that noise may add
VALLEY = 0.98  # correlation from which two parameters are one
LEARNED = "effects.learned_term."  # its coefficients are many, and held by their prior on purpose: none is named by itself


def beyond_the_rod(spectra, actuator, bench) -> str:
    """That a reading moves further than the rod can, in words, by recordings too slow for its resonance."""
    if bench.output != "displacement" or actuator.piezo is not None or actuator.mechanics is None:
        return ""
    reach, slow = float(actuator.strained.reach), SLOW * float(actuator.mechanics.f0)
    stroke = max((s.peak_to_peak for s in spectra if s.frequency < slow), default=0.0)
    if stroke <= MOST_STROKE * reach:
        return ""
    return (
        f"; the reading moves by {sized('m', stroke)}, and the rod gives {sized('m', reach)} at most (lambda_s l_rod): no parameter is physical; "
        "set scale or unit in [columns.displacement], or lambda_s and l_rod of the bench"
    )


def contradicted(bench, choices) -> str:
    """A sentence where the recordings are met from another start than the bench states."""
    if bench.start not in RESTS or choices.rest in (*RESTS[bench.start], "held", "auto"):
        return ""
    return f"; the recordings are not met from the start that the bench states, {bench.start}, but from {STATES[choices.rest]}"


def recording_fits(problem, residual, recordings, bench):
    """Misfit of each recording from the whitened residual vector."""
    R, H = problem.target.lines.shape
    real = residual[: R * H].reshape(R, H)
    imag = residual[R * H :].reshape(R, H - 1)
    deviations = np.asarray(problem.target.deviations)
    rows = []
    for k, (recording, s) in enumerate(zip(recordings, problem.spectra, strict=True)):
        finite = np.isfinite(deviations[k])
        number = 2 * finite.sum() - finite[0]
        chi2 = float((real[k] ** 2).sum() + (imag[k] ** 2).sum())
        misfit = np.where(finite, deviations[k], 0.0) * (real[k] + 1j * np.append(0.0, imag[k]))
        power = np.abs(misfit - hum_part(misfit, s)) ** 2
        power[1:] *= 2
        power[0] *= not s.zero  # a zero of its own is no error
        between = float(np.mean(s.residue**2))
        rows.append(
            RecordingFit(
                recording.origin.get("file", recording.name) if "[" not in recording.name else recording.name,
                recording.origin.get("sha256", ""), bench.output, si_unit(bench.output),
                s.frequency, s.periods, s.noise_rms, float(np.sqrt(power.sum() + between)), chi2 / number,
            )
        )  # fmt: skip
    return tuple(rows)


def valleys(found) -> str:
    """The pairs of parameters that these recordings do not tell apart, in words: their priors do, if any."""
    named = {pair: value for pair, value in found.items() if LEARNED not in pair}
    pairs = [f"{' and '.join(pair.split('~'))} (correlation {value:.2f})" for pair, value in named.items() if abs(value) > VALLEY]
    return f"; a valley: only their priors part {', '.join(pairs)}" if pairs else ""


def loose(rows) -> str:
    """The parameters that these recordings do not hold, in words, and why."""
    loose = [e for e in rows if e.free and not e.identified]
    found = [f"{e.name} ({e.why})" for e in loose if not e.name.startswith(LEARNED)]
    held = "; a prior holds the coefficients of the learned term" if len(found) < len(loose) else ""
    return (f"; not identified: {', '.join(found)}" if found else "") + held


def guessed(recordings, bench) -> str:
    """That the noise of recordings without a repeat is a guess, in words."""
    number = sum(r.noise_is_a_guess(bench.output) for r in recordings)
    if not number:
        return ""
    return f"; the noise of {number} of {len(recordings)} recordings is a guess from their highest orders: record three or more periods"


def strayed(recordings) -> str:
    """Single samples that were put where the other periods are, in words."""
    found = {Path(r.name).name: stray_samples(r)[0] for r in recordings if stray_samples(r)[0]}
    if not found:
        return ""
    told = ", ".join(f"{name} ({number})" for name, number in list(found.items())[:3])
    return f"; samples that stood far off alone were left out: {told}{' and others' if len(found) > 3 else ''}"


def unsettled(spectra) -> str:
    """What was taken out of recordings that began before the mechanics had settled, in words."""
    starts = [float(np.abs(s.start).max()) for s in spectra if s.start is not None]
    if not starts:
        return ""
    return f"; {len(starts)} of {len(spectra)} recordings began unsettled: a decaying motion of up to {sized('m', max(starts), digits=2)} was taken out"


def outcome(chi2n, rows, solution, parameters, problem, limit=None) -> str:
    """What the fit means, with its remedy. `limit`: the Jacobians that it was given."""
    if solution.interrupted:
        return f"interrupted after {solution.jacobians} Jacobians; this is what was reached: give it as --model to go on from its constants"
    if not chi2n < LOST:
        wrong = swapped(problem.spectra, rows) or "check signs and units of the recordings, and the bench file"
        named = Path(max(rows, key=lambda r: np.nan_to_num(r.chi2_per_sample, nan=np.inf)).file).name
        size = (
            f"what repeats is {np.sqrt(chi2n):.3g} times its noise"
            if np.isfinite(chi2n)
            else "the simulation fails at its constants"
        )
        return f"the fit has led nowhere: {size} (worst: {named}); {wrong}"
    bound = [e.name for e in parameters if e.at_bound and not e.name.startswith("effects.")]  # where a law's shape ends it may stay
    if not solution.converged:
        after = f"stopped after {solution.jacobians} Jacobians before it settled"
        if bound:
            return f"{after}: {', '.join(bound)} sits at its bound; free another parameter or check signs, units and the bench file"
        if limit is not None and solution.jacobians < limit:
            return f"{after}: no step leads on from there; start nearer, hold a parameter or give it a prior (see the bench file)"
        return f"{after}; raise --max-jacobians or start nearer (see the bench file)"
    worst = max(rows, key=lambda r: r.chi2_per_sample)
    if bound:
        far = f", and what repeats is {np.sqrt(chi2n):.3g} times its noise (worst: {Path(worst.file).name})" if chi2n > 2 else ""
        return f"{', '.join(bound)} sits at its bound{far}; free another parameter or check signs, units and the bench file"
    if chi2n < 1.1 and worst.chi2_per_sample < 1.6:
        return "the recordings are met to their noise; the error bars hold"
    if chi2n > 2:
        return (
            f"what repeats is {np.sqrt(chi2n):.1f} times its noise (worst: {worst.frequency:.4g} Hz), so the error bars do not hold and no "
            "parameter is physical yet; run magjax diagnose on the same files"
        )
    alone = f", and {worst.chi2_per_sample:.3g} in {Path(worst.file).name}" if chi2n < 1.1 else ""
    return (
        f"chi2/N = {chi2n:.2f}{alone}, a little above the noise; the error bars are too narrow: a rough density, or a weak effect "
        "(magjax diagnose tells which)"
    )
