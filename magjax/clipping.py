"""Clipping: crests cut off flat by a converter or an amplifier at its limit, told by their shape.

At an honest crest the signal is round: what rests within a tolerance of the extreme, L samples between slopes s1 and s2 on
either side, hides an arch of height L s1 s2 / (2 (s1 + s2)) by these slopes, which is that tolerance again, whatever the
curvature. At a clipped crest the arch is far higher, and the slopes begin at once, at a corner; where a reading saturates they
begin slowly. A level that is held on purpose has a corner, too, but straight or sudden flanks, or holds at other levels.

In noise coarser than a converter's counts no value comes back often: a limit that does, or a stretch of equal samples, was not
measured.
"""

import numpy as np

from .errors import RecordingError
from .plausibility import UNITS, si_unit
from .words import sized

RESTING, MOVES = 0.1, 0.3  # of the samples at the highest or lowest value, from which the noise is taken between: so many must be there
FEWEST = 5  # samples that rest: an honest crest leaves two equal ones on its top, three with some luck
MOST_JUDGED = 16  # crests, evenly over the record
ARCH = 4.0  # hidden height in tolerances; one where the crest is a parabola, two for t^4
FLAT_TOO = 3.0  # the same of a crest that is taken for as flat as another
LARGEST = 0.021  # tolerance in spans: above it noise hides what a crest is like
CORNER = 0.5  # slope beside the plateau over that farther off; 0.75 where a sine is cut, 0.4 for t^4, less where it saturates
STEP = 3.0  # the same from which a flank falls off to a hold beside the plateau: a step, for slopes grow away from a crest
SEEN = 1e-4  # of the span: less noise hides no crest
NOISY = 1.5  # counts of noise, rms: from here on values seldom come back
TIED, TIED_MORE = 8, 4.0  # samples that equal the extreme, and how many times as often as a level near it
STUCK = 10  # equal samples in a row
APART = 4.0  # standard deviations of a plateau's level that two of one limit may differ by, beside half a deviation of the noise
WAVY = 8.0  # deviations of chi2 from what noise leaves of a flat plateau in means of eight samples
KEPT = 0.5  # of the noise beside it, that a plateau has which acts before the noise
PASSED = 0.02  # of the span, by which another recording must pass a level
CORNER_IN_NOISE = 0.65  # a plateau of many tolerances' depth has lost the slow part of a round approach


def quantum(values: np.ndarray) -> float:
    """The step of a quantised channel, 0 where it is not quantised."""
    levels = np.unique(values)
    steps = np.diff(levels)
    steps = steps[steps > 1e-9 * np.ptp(levels)] if len(steps) else steps  # not the last digits of equal numbers
    if len(steps) < 3:
        return float(steps.min()) if len(steps) else 0.0
    step = float(np.quantile(steps, 0.1, method="lower"))
    for _ in range(6):  # as Euclid does, but for strays: levels seldom visited leave gaps of several steps
        for most in (4, 20):  # a step read from rounded figures, by more of its multiples
            times = np.round(steps / step)
            alike = (times > 0) & (times <= most) & (np.abs(steps - times * step) < 0.02 * step)
            if alike.any():
                step = float(steps[alike] @ times[alike] / (times[alike] @ times[alike]))
        beside = np.abs(steps - step * np.round(steps / step))
        if np.mean(beside < 0.05 * step) > 0.9:
            return step
        step = float(np.quantile(beside[beside >= 0.05 * step], 0.1, method="lower"))
    return 0.0


def fast_noise(values: np.ndarray) -> float:
    """Rms of what changes from sample to sample, by the lower quartile of fourth differences: corners do not count.

    Nor do five equal samples in a row: noise that was clipped with its signal is gone from the plateau.
    """
    rests = np.convolve(np.diff(values) == 0, np.ones(4), "valid") > 3.5
    moving = np.abs(np.diff(values, 4))[~rests]
    return float(np.quantile(moving, 0.25) / (0.3186 * np.sqrt(70))) if len(moving) else 0.0


def _in_noise(values: np.ndarray) -> float:
    """The fast noise of a channel, (time,), most of which moves by more than `NOISY` counts of it; 0 of others."""
    if len(values) < 4 * FEWEST:
        return 0.0
    # by eighth differences: a smooth signal has none to speak of, down to ten samples a swing
    moving = np.abs(np.diff(values, 8))
    resting = (values == values.max()) | (values == values.min())
    if resting.mean() > RESTING:  # cut with their noise, or a signal that rests: by what is between
        between = ~np.lib.stride_tricks.sliding_window_view(resting, 9).any(axis=1)
        moving = moving[between] if between.mean() > MOVES else moving
    noise = float(np.quantile(moving, 0.25) / (0.3186 * np.sqrt(12870)))
    return noise if noise > max(NOISY * quantum(values), SEEN * np.ptp(values)) else 0.0


def refuse_clipping(name: str, channel: str, values: np.ndarray, drive: np.ndarray | None = None, holds=()):
    """Raise `RecordingError` where a channel, (time,), is clipped or stuck; `drive`, (time,): what may hold still meanwhile; `holds`: sides
    (1.0 highest, -1.0 lowest) where a plateau that keeps its noise is no limit."""
    values = np.asarray(values, float)
    unit = "V" if "emf" in channel else si_unit(channel) if channel in UNITS else ""
    stuck = stuck_stretch(values)
    if stuck is not None:
        raise RecordingError(
            f"{name}: {channel} stands still at {sized(unit, values[stuck[0]], digits=4)} for {stuck[1]} samples from sample {stuck[0]}, in which its "
            "noise is gone: samples were lost or the converter hung; record again or cut there",
            _shown(channel, unit, values, *stuck),
        )
    for sign, word in ((1.0, "highest"), (-1.0, "lowest")):
        crest = clipped_crest(sign * values, drive)
        found = crest or cut_in_noise(sign * values)
        if found is not None:
            first, length = found
            level = float(np.median(values[first : first + length]))
            rests = {"rests": (sign, level)} if crest and _keeps_noise(values, first, length) else {}
            if rests and sign in holds:
                continue
            raise RecordingError(
                f"{name}: {channel} is clipped at its {word} value {sized(unit, level, digits=4)} for {length} samples from sample {first}; "
                "lower the gain or the drive and record again",
                {**_shown(channel, unit, values, first, length), **rests},
            )


def _keeps_noise(values, first, length) -> bool:
    """Whether a plateau has the noise of what is beside it, coarser than a converter's counts: what it rests by acts before the noise."""
    noise = fast_noise(values)
    return noise > NOISY * quantum(values) and fast_noise(values[first : first + length]) > KEPT * noise


def is_passed(shown: dict, others) -> bool:
    """Whether the level of a plateau that keeps its noise is passed elsewhere in the same channel: it is no limit of the instrument then,
    but what is measured holds there, as behind a play. `shown`: of its `RecordingError`; `others`: the channel in other recordings."""
    side, level = shown["rests"]
    margin = 10 * fast_noise(shown["values"]) + PASSED * np.ptp(shown["values"])
    return any(np.max(side * np.asarray(x, float)) > side * level + margin for x in others)


def _shown(channel, unit, values, first, length) -> dict:
    """Where a channel, (time,), is at fault, as a `RecordingError` holds it."""
    return {"channel": channel, "unit": unit, "values": values, "first": int(first), "length": int(length)}


def clipped_crest(x: np.ndarray, drive: np.ndarray | None = None) -> tuple[int, int] | None:
    """(first sample, samples) of the longest clipped top of a signal, (time,); None where its crests are honest."""
    span = float(np.ptp(x))
    if len(x) < 4 * FEWEST or not span > 0 or not np.all(np.isfinite(x)):
        return None
    step, noise = quantum(x), fast_noise(x)
    resting = max(0.6 * step, 1e-9 * span)
    # rounding alone looks like noise of 0.3 to 0.4 steps
    noisy = max(9 * noise if noise > 0.5 * step else 2.6 * step, resting)
    for tolerance, corner in ((resting, CORNER), (noisy, CORNER_IN_NOISE)):
        if tolerance > LARGEST * span:
            break
        top = x > x.max() - tolerance
        if top[0] and top[-1]:  # a record that begins and ends on a crest is taken to close
            shift = int(np.argmin(top))
            again = clipped_crest(np.roll(x, -shift), None if drive is None else np.roll(drive, -shift)) if not top.all() else None
            return None if again is None else ((again[0] + shift) % len(x), again[1])
        runs = _runs(top)
        longest = max(length for _, length in runs)
        if longest < FEWEST:
            continue
        runs = [run for run in runs if run[1] >= max(FEWEST, longest / 2)]
        runs = runs[:: len(runs) // MOST_JUDGED + 1]
        cut = [run for run in runs if _is_cut(x, *run, max(tolerance, step, 3 * noise), max(0.5 * step, noise), corner)]
        if 2 * len(cut) >= len(runs) and cut:
            best = max(cut, key=lambda run: run[1])
            scatter = max(0.5 * step, noise)
            honest = (
                _is_wavy(x, cut, scatter)
                or _holds_elsewhere(x, best[1], tolerance, span)
                or _rests(drive, *best)
                or _cut_elsewhere(x, best, tolerance, step, noise)
            )
            if not honest:
                return best
    return None


def stuck_stretch(x: np.ndarray) -> tuple[int, int] | None:
    """(first sample, samples) of the longest stretch of equal samples, (time,), that noise would not leave; None without one."""
    runs = [run for run in _runs(np.diff(x) == 0) if run[1] >= STUCK - 1]
    if not runs or not _in_noise(x):
        return None
    # at a limit a signal may rest: that is clipping
    inside = [(a, n + 1) for a, n in runs if x.min() < x[a] < x.max()]
    return max(inside, key=lambda run: run[1]) if inside else None


def cut_in_noise(x: np.ndarray) -> tuple[int, int] | None:
    """(first sample, samples) of the tops of a signal, (time,), cut with their noise: its highest value comes far too often."""
    noise = _in_noise(x)
    if not noise:
        return None
    at_top = np.flatnonzero(x == x.max())
    near = np.unique(x[(x < x.max()) & (x > x.max() - 4 * noise)], return_counts=True)[1]
    if not len(near) or len(at_top) < max(TIED, TIED_MORE * near.max()):  # a step of a staircase has nothing near below it
        return None
    return max(_runs(x == x.max()), key=lambda run: run[1])


def _runs(where) -> list[tuple[int, int]]:
    """(first, length) of every stretch of True."""
    edges = np.diff(np.concatenate([[0], where.astype(int), [0]]))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return [(int(a), int(b - a)) for a, b in zip(starts, ends, strict=True)]


def _is_cut(x, first, length, tolerance, scatter, corner, arch=ARCH, leaning: bool = False) -> bool:
    """Whether both flanks meet the plateau at a corner, are not straight, and hide an `arch` of so many tolerances; `leaning`: a plateau
    that drifts serves."""
    rest = x[first + 1 : first + length - 1]
    level = float(np.median(rest))
    thirds = [part.mean() for part in np.array_split(rest, 3)]
    round_by = abs(thirds[1] - 0.5 * (thirds[0] + thirds[2])) if leaning else np.ptp(thirds)
    if round_by > 4 * scatter / np.sqrt(len(rest) / 3) + 0.02 * tolerance:
        return False  # rounded
    slopes = []
    for depth in _flanks(level - x, first, length):
        reach = _reach(depth, float(np.ptp(x)), scatter)
        middle = int(np.argmax(depth > 0.5 * depth[reach])) if reach else 0
        near = max(2, min(length // 8, middle // 4))
        if middle < 3 * near:
            return False  # too few samples to tell a jump from a flank
        slope, beyond = (depth[near] - depth[0]) / near, (depth[3 * near] - depth[near]) / (2 * near)
        if not slope > max(corner * beyond, 0.0) or slope > STEP * beyond or _straight(depth[1:reach], scatter):
            return False
        slopes.append(slope)
    return length * slopes[0] * slopes[1] / (2 * sum(slopes)) > arch * tolerance


def _is_wavy(x, runs, scatter) -> bool:
    """Whether plateaus have the same hills and dips each time: a reading that folds back, as by fringes, not a limit."""
    if not scatter:
        return False
    length = min(length for _, length in runs)
    profile = np.mean([x[first + (n - length) // 2 :][:length] for first, n in runs], axis=0)
    inside = np.flatnonzero(profile > np.median(profile) - 2 * scatter)  # of the flanks what tolerance took in
    edge = max(2, len(inside) // 20)
    profile = profile[inside[0] + edge : inside[-1] + 1 - edge]
    blocks = np.array_split(profile, max(len(profile) // 8, 3))
    if len(profile) < 4 * len(blocks):
        return False
    means, counts = np.array([b.mean() for b in blocks]), np.array([len(b) for b in blocks])
    level = np.average(means, weights=counts)
    misfit = float(np.sum(counts * (means - level) ** 2)) * len(runs) / scatter**2
    return misfit > len(blocks) + WAVY * np.sqrt(2 * len(blocks))


def _cut_elsewhere(x, best, tolerance, step, noise) -> bool:
    """Whether another crest is as flat at a level of its own: a limit is the same each time, where a strain turns at zero it drifts along."""
    scatter = max(0.5 * step, noise)

    def level(first, length):
        middle = x[first + length // 4 : first + length - length // 4]
        return float(np.mean(middle)), 0.5 * scatter + APART * scatter / np.sqrt(len(middle))

    top, unsure = level(*best)
    crests = _runs(x > 0.5 * (x.max() + x.min()))
    for first, length in crests[:: len(crests) // MOST_JUDGED + 1]:
        own = x[first : first + length]
        start, count = max(_runs(own > own.max() - tolerance), key=lambda run: run[1])
        if count < max(FEWEST, best[1] // 2) or not _is_cut(x, first + start, count, max(tolerance, step, 3 * noise), scatter, CORNER, FLAT_TOO, True):
            continue
        found, error = level(first + start, count)
        if top - found > np.hypot(unsure, error):
            return True
    return False


def _flanks(depth, first, length):
    """Depth below a plateau before it (backwards) and after it, the samples next to it first; a record that closes goes on."""
    before, after = depth[:first][::-1], depth[first + length :]
    if abs(depth[0] - depth[-1]) <= 2 * np.abs(np.diff(depth)).max():
        before, after = np.concatenate([before, after[::-1]]), np.concatenate([after, before[::-1]])
    return before, after


def _reach(depth, span, scatter) -> int:
    """Samples of a flank: down to its turning point or most of the span."""
    if not len(depth):
        return 0
    turned = np.flatnonzero((np.maximum.accumulate(depth) - depth > 10 * scatter + 1e-9 * span) | (depth > 0.95 * span))
    return max(int(turned[0]) if len(turned) else len(depth), 1) - 1


def _straight(flank, scatter) -> bool:
    """Whether a flank is a ramp: a cubic fits it no better than a line does."""
    place = np.linspace(-1, 1, len(flank))
    line, cubic = (float(np.sum((flank - np.polyval(np.polyfit(place, flank, d), place)) ** 2)) for d in (1, 3))
    return line - cubic < 5 * scatter**2 + len(flank) * (1e-3 * np.ptp(flank)) ** 2


def _holds_elsewhere(x, length, tolerance, span) -> bool:
    """Whether the signal rests half as long at a level between its extremes, as a staircase does."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    width = max(FEWEST, length // 2)
    low, high = minimum_filter1d(x, width), maximum_filter1d(x, width)
    between = (low > x.min() + 0.05 * span) & (high < x.max() - 0.05 * span)
    return bool(np.any(between & (high - low <= 2 * tolerance)))


def _rests(drive, first, length) -> bool:
    """Whether the drive, (time,), stands still during (most of) the plateau: what follows it rests by right."""
    if drive is None:
        return False
    margin = length // 10
    during = drive[first + margin : first + length - margin]
    return float(np.ptp(during)) <= max(1.01 * quantum(drive), 6 * fast_noise(drive), 1e-6 * float(np.ptp(drive)))
