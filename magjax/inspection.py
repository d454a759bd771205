"""Is a recording fit to use? Judgements that need no model, for `magjax check`."""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Card:
    """What was found: `facts` name -> text, `problems`: sentences with their mend."""

    name: str
    facts: dict
    problems: tuple[str, ...]

    def as_dict(self) -> dict:
        """For --json."""
        return {"recording": self.name, "facts": self.facts, "problems": list(self.problems), "usable": not self.problems}

    def __str__(self):
        rows = [f"{self.name}: {'fit to use' if not self.problems else 'NOT fit to use'}"]
        rows += [f"  {k:22s} {v}" for k, v in self.facts.items()]
        return "\n".join(rows + [f"  problem: {p}" for p in self.problems])


def quantum(values: np.ndarray) -> float:
    """The step of a quantised channel, 0 where it is not quantised."""
    steps = np.diff(np.unique(values))
    if len(steps) < 3:
        return float(steps.min()) if len(steps) else 0.0
    smallest = float(np.quantile(steps, 0.1))
    ratio = steps / smallest
    return smallest if np.mean(np.abs(ratio - np.round(ratio)) < 0.05) > 0.9 and smallest > 0 else 0.0


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
    facts, problems = {}, []
    facts["samples"] = f"{len(x)} at {recording.dt:.6g} s ({len(x) * recording.dt:.4g} s)"
    facts["drive"] = f"{bench.drive} {x.min():.5g} .. {x.max():.5g}"
    facts["reading"] = f"{bench.output} {y.min():.5g} .. {y.max():.5g}"
    for name, v in ((bench.drive, x), (bench.output, y)):
        step = quantum(v)
        if step > 0:
            facts[f"{name} counts"] = f"step {step:.3g}, {np.ptp(v) / step:.0f} steps over the range"
            if np.ptp(v) / step < 40:
                problems.append(f"{name} spans only {np.ptp(v) / step:.0f} counts; raise the gain of the converter")
    if f is None:
        facts["periods"] = "aperiodic: usable as a check recording, not in a fit"
    else:
        facts["fundamental"] = f"{f:.6g} Hz, {len(x) * recording.dt * f:.3f} periods of {1 / (f * recording.dt):.2f} samples"
        facts["lag of the reading"] = f"{channel_lag(x, y, recording.dt) * 1e3:.4g} ms"
        _judge_repeats(recording, x, y, f, facts, problems)
    H = _applied(bench, x)
    facts["visited plane"] = f"applied field {H.min():.5g} .. {H.max():.5g} A/m"
    whole = _plane(bench)
    if whole is not None:
        share = min((H.max() - H.min()) / (whole[1] - whole[0]), 1.0) ** 2
        facts["visited plane"] += f", {share:.0%} of the relays that the bench's limits reach"
    limit = bench.limits.get("current_A" if bench.drive == "current" else "field_A_per_m")
    if limit and np.abs(x).max() > 1.02 * limit:
        facts["limit"] = f"the drive passes the bench's limit of {limit:g}; widen [limits] if that is meant"
    return Card(recording.name, facts, tuple(problems))


def _applied(bench, x):
    if bench.drive == "field":
        return x
    return bench.constants.get("coil.c0", 1.0) * x + bench.constants.get("coil.H_bias", 0.0)


def _plane(bench):
    """The range of applied field that the bench's limits reach, A/m, or None where none are stated."""
    limit = bench.limits.get("current_A" if bench.drive == "current" else "field_A_per_m")
    if not limit:
        return None
    ends = _applied(bench, np.array([-limit, limit]))
    return float(ends[0]), float(ends[1])


def _judge_repeats(recording, x, y, f, facts, problems):
    per = 1 / (f * recording.dt)
    count = int(np.floor(len(y) / per + 1e-6))
    if count < 2:
        facts["noise"] = "one period only: it cannot be told from the repeats"
        return
    phase = np.arange(int(per)) / int(per)
    t = np.arange(len(y)) / per
    blocks = np.stack([np.interp(k + phase, t, y) for k in range(count)])
    spread = blocks - blocks.mean(axis=0)
    noise = float(np.sqrt(np.mean(spread**2) * count / (count - 1)))
    span = float(np.ptp(y))
    facts["noise from repeats"] = f"{noise:.3g} rms ({noise / span:.2g} of the range)"
    drift = float(blocks[-1].mean() - blocks[0].mean())
    settle = float(np.sqrt(np.mean((blocks[0] - blocks[-1]) ** 2)))
    late = float(np.sqrt(np.mean((blocks[-2] - blocks[-1]) ** 2))) if count > 2 else settle
    facts["drift"] = f"{drift:.3g} from first to last period"
    if abs(drift) > 0.02 * span and abs(drift) > 6 * noise / np.sqrt(per):
        problems.append(f"the reading drifts by {drift:.3g} ({abs(drift) / span:.1%} of the range); warm up or remove the drift")
    if count > 2 and settle > 0.02 * span and settle > 4 * late:
        problems.append(f"unsettled transient: the first period is {settle:.3g} rms off the last; cut it or wait before recording")
