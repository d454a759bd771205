"""Is a recording fit to use? Judgements that need no model, for `magjax check`."""

import dataclasses

import numpy as np

from .clipping import quantum
from .errors import RecordingError
from .plausibility import STRONG_FIELD, si_unit
from .recording import NO_ANSWER, follows_nothing, stray_samples
from .terms import DRIVE_UNITS
from .words import sized

LITTLE = 1e-4  # of the relays of the plane: a hundredth of its width
MOST_FILLED = 0.05  # of the samples: more is no measurement


@dataclasses.dataclass(frozen=True)
class Card:
    """What was found: `facts` name -> text, `problems` and `warnings`: sentences with their mend; with a problem it is unfit."""

    name: str
    facts: dict
    problems: tuple[str, ...]
    warnings: tuple[str, ...] = ()

    def as_dict(self) -> dict:
        """For --json."""
        return {
            "recording": self.name,
            "facts": self.facts,
            "problems": list(self.problems),
            "warnings": list(self.warnings),
            "usable": not self.problems,
        }

    def __str__(self):
        rows = [f"{self.name}: {'fit to use' if not self.problems else 'NOT fit to use'}"]
        rows += [f"  {k:22s} {v}" for k, v in self.facts.items()]
        return "\n".join(rows + [f"  problem: {p}" for p in self.problems] + [f"  warning: {w}" for w in self.warnings])


def inspect_files(paths, bench) -> list[Card]:
    """A card of every recording in every file; of a file that cannot be read, one whose problem says why."""
    from .readers import load_recordings

    cards = []
    for path in paths:
        try:
            cards += [inspect(r, bench) for r in load_recordings([path], bench)]
        except RecordingError as error:
            cards.append(Card(str(path), {}, (str(error),)))
    return cards


def channel_lag(drive: np.ndarray, reading: np.ndarray, dt: float) -> float:
    """Lag of the reading behind the drive by their fundamentals' phase, s."""
    a, b = np.fft.rfft(drive - drive.mean()), np.fft.rfft(reading - reading.mean())
    k = int(np.argmax(np.abs(a)))
    return float(-np.angle(b[k] / a[k]) / (2 * np.pi * k / (len(drive) * dt))) if k else 0.0


def inspect(recording, bench) -> Card:
    """Every judgement on one recording."""
    x = np.asarray(recording.channels[bench.drive])
    y = np.asarray(recording.channels[bench.output])
    f = recording.frequency()
    facts, problems, warnings = {}, [], []
    facts["samples"] = f"{len(x)} at {recording.dt:.6g} s ({len(x) * recording.dt:.4g} s)"
    facts["drive"] = f"{bench.drive} {x.min():.5g} .. {x.max():.5g} {DRIVE_UNITS[bench.drive]}"
    facts["reading"] = f"{bench.output} {sized(si_unit(bench.output), y.min(), y.max(), digits=5, joined=' .. ')}"
    for name, v in ((bench.drive, x), (bench.output, y)):
        step = quantum(v)
        if step > 0:
            facts[f"{name} counts"] = f"step {step:.3g}, {np.ptp(v) / step:.0f} steps over the range"
            if np.ptp(v) / step < 40:
                problems.append(f"{name} spans only {np.ptp(v) / step:.0f} counts; raise the gain of the converter")
    _judge_gaps(recording, facts, problems, warnings)
    _judge_strays(recording, warnings)
    _judge_clock(recording, warnings)
    if f is None:
        facts["periods"] = "aperiodic: usable as a check recording, not in a fit"
    else:
        facts["fundamental"] = f"{f:.6g} Hz, {len(x) * recording.dt * f:.3f} periods of {1 / (f * recording.dt):.2f} samples"
        facts["lag of the reading"] = f"{channel_lag(x, y, recording.dt) * 1e3:.4g} ms"
        _judge_repeats(recording, bench.output, facts, problems)
        if (stated := recording.contradicted_frequency()) is not None:
            warnings.append(
                f"the header says {stated:g} Hz, the drive repeats at {f:.6g} Hz and is believed; " + _clock(stated / f)
            )
        if recording.noise_is_a_guess(bench.output):
            warnings.append(
                "less than two periods: a fit can only guess the noise from the high orders, and its errors with it; record three or more"
            )
    H = _applied(bench, x)
    terms = bench.terms
    facts["visited plane"] = f"{terms.applied} {H.min():.5g} .. {H.max():.5g} {terms.unit}"
    whole = _plane(bench)
    if whole is not None:
        share = min((H.max() - H.min()) / (whole[1] - whole[0]), 1.0) ** 2
        facts["visited plane"] += f", {share:.0%} of the relays that the bench's limits reach"
        if share < LITTLE:
            warnings.append(f"the drive is hardly felt: check unit and scale of [columns.{bench.drive}], which multiply")
    limit, peak, unit = bench.limit, float(np.abs(x).max()), DRIVE_UNITS[bench.drive]
    if limit and peak > 1.02 * limit:
        warnings.append(
            f"the drive reaches {peak:.4g} {unit}, the bench's limit is {limit:g} {unit}; check the column's unit, or widen [limits] if that is meant"
        )
    elif bench.drive == "current" and "coil.c0" in bench.constants and np.abs(H).max() > STRONG_FIELD:
        warnings.append(
            f"{peak:.4g} A make {np.abs(H).max():.3g} A/m by the bench's c0, far more than saturates the rod; "
            "if the column is in mA, name it current_mA, and state [limits] current_A in the bench"
        )
    return Card(recording.name, facts, tuple(problems), tuple(warnings))


def _clock(ratio: float) -> str:
    """The mend of a header that contradicts the drive: a time column in another unit, or the header itself."""
    for unit, factor in (("ms", 1e3), ("us", 1e6)):
        if abs(ratio / factor - 1) < 0.02:
            return f"its time is in {unit}, it seems: name the column time_{unit}"
    return "mend `# frequency_Hz`"


def _judge_gaps(recording, facts, problems, warnings):
    metadata = recording.origin.get("metadata", {})
    filled, widest = (
        int(v) if isinstance(v, (int, float)) and 0 < v < 1e12 else 0
        for v in map(metadata.get, ("bridged_samples", "widest_gap_samples"))
    )
    if not filled:
        return
    share = filled / len(recording.time)
    facts["gaps"] = f"{filled} samples missing ({share:.2g} of all), filled from the harmonics of the rest" + (
        f"; the widest gap is {widest} samples" if widest else ""
    )
    # captures that are joined stand in for each other: there the widest gap is not told
    if widest and share > MOST_FILLED:
        problems.append(f"{facts['gaps']}: too much to be called measured; record again")
    else:
        warnings.append(f"{filled} missing samples were filled; look for the recorder's drops if they come often")


def _judge_strays(recording, warnings):
    number, channels = stray_samples(recording)
    if number:
        verb = "sample stands" if number == 1 else "samples stand"
        warnings.append(
            f"{number} {verb} far off alone ({channels}), as interference leaves them, and {'is' if number == 1 else 'are'} put where the other "
            "periods are; look for switching loads if it comes often"
        )


def _applied(bench, x):
    if bench.drive != "current":
        return x
    return bench.constants.get("coil.c0", 1.0) * x + bench.constants.get("coil.H_bias", 0.0)


def _plane(bench):
    """The range of applied field (voltage) that the bench's limits reach, A/m (V), or None where none are stated."""
    if not bench.limit:
        return None
    ends = _applied(bench, np.array([-bench.limit, bench.limit]))
    return float(ends[0]), float(ends[1])


JITTER = 0.03  # of a step, rms: above it the time axis, taken for uniform, moves the samples along the loop


def _judge_clock(recording, warnings):
    t = np.asarray(recording.time)
    if len(t) > 3:
        jitter = float(np.std(t - np.polyval(np.polyfit(np.arange(len(t)), t, 1), np.arange(len(t)))) / recording.dt)
        if jitter > JITTER:
            warnings.append(
                f"the clock jitters by {jitter:.0%} of a step (rms), and is taken for uniform; resample, or time the samples by hardware"
            )


def _judge_repeats(recording, channel, facts, problems):
    y, blocks = np.asarray(recording.channels[channel]), recording.repeats(channel)
    count, per = len(blocks), recording.period_samples()
    if count < 2:
        facts["noise"] = "one period only: it cannot be told from the repeats"
        return
    noise, unit = recording.repeat_noise(channel), si_unit(channel)
    span = float(np.ptp(y))
    if follows_nothing(recording, channel):
        problems.append(NO_ANSWER.format(channel=channel, drive=recording.drive))
    facts["noise from repeats"] = f"{sized(unit, noise)} rms ({noise / span:.2g} of the range)"
    drift = float(blocks[-1].mean() - blocks[0].mean())
    settle = float(np.sqrt(np.mean((blocks[0] - blocks[-1]) ** 2)))
    late = float(np.sqrt(np.mean((blocks[-2] - blocks[-1]) ** 2))) if count > 2 else settle
    facts["drift"] = f"{sized(unit, drift)} from first to last period"
    if abs(drift) > 0.02 * span and abs(drift) > 6 * noise / np.sqrt(per):
        problems.append(f"the reading drifts by {sized(unit, drift)} ({abs(drift) / span:.1%} of the range); warm up or remove the drift")
    if count > 2 and settle > 0.02 * span and settle > 4 * late:
        problems.append(f"unsettled transient: the first period is {sized(unit, settle)} rms off the last; cut it or wait before recording")
