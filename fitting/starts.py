"""Where a fit starts: the masses by constrained least squares on the equation error (T&B Sec. 2.1).

The measured reading is led back through the sensor and mechanics to M, the drive and dM/dt give H by (4), and M is
then linear in the masses: nonnegative least squares with the roughness penalties, no simulation.
"""

import numpy as np

from magjax.constants import MU0
from magjax.param import in_numpy
from magjax.preisach.operator import unreached_share

from .solver import bounded_minimum
from .spectra import evaluate_lines

NEAR_ZERO = 0.3  # of the largest |M|, below which it may change sign
TOUCHING = 0.03  # of the largest strain, below which it may be taken for none
SIGNS = 50  # instants of a period at which the sign of M is sought
DIPS = 0.1  # of the largest |M|, by which it must rise on both sides of where it is taken to pass through zero


def operator_rows(basis, field: np.ndarray, history=()) -> np.ndarray:
    """d M / d x at total mass 1 for a field sequence after negative saturation and a history: (time, unknowns).

    M = bottom + rows @ x: the last branch's Everett value on top of that of the reversal it started from.
    """
    stack = [(basis.low, 0)]  # extrema with the number of their event
    events, samples = [], []  # (alpha, beta, sign, parent)
    events.append((basis.low, basis.low, 0.0, -1))
    for value in np.concatenate([np.asarray(history, float), field]):
        tip, number = stack[-1]
        rising = value >= tip
        if len(stack) >= 2 and (value - tip) * (tip - stack[-2][0]) >= 0:
            stack.pop()
        while len(stack) >= 3 and abs(value - stack[-1][0]) >= abs(stack[-2][0] - stack[-1][0]):
            del stack[-2:]
        base, number = stack[-1]
        alpha, beta, sign = (value, base, 2.0) if value >= base else (base, value, -2.0)
        events.append((alpha, beta, sign, number))
        if value != base:
            stack.append((value, len(events) - 1))
        samples.append(len(events) - 1)
        del rising
    alpha, beta, sign, parent = (np.asarray(c) for c in zip(*events, strict=True))
    rows = sign[:, None] * basis.everett(alpha, beta)
    total = np.zeros_like(rows)
    for k in range(1, len(rows)):
        total[k] = total[parent[k]] + rows[k]
    return total[np.asarray(samples)][len(history) :]


def unreached_row(basis, highest, lowest, rest):
    """What every basis function adds to M through relays that a drive leaves up, as `Preisach.unreached`: (unknowns,)."""
    if rest is None or rest <= basis.low:
        return np.zeros(basis.unknowns)
    step = (basis.high - basis.low) / basis.size
    edge = (basis.low - rest) / step + np.arange(basis.size + 1)
    share = unreached_share(edge, (highest - rest) / step, (lowest - rest) / step, np)
    return 2 * (basis.cells.T @ (np.tril(share) * (1 + np.eye(basis.size))).ravel())


def inferred_loops(spectra, deviations, actuator, samples: int = 200, touching: bool = False):
    """Field and magnetization over a period from the reading, by (4) and (5) backwards: lists of (H, M, trust).

    `touching`: a strain that comes near zero is taken to reach it there, so that M may turn its sign, and M to turn it wherever the strain
    falls near zero and rises again on the way to a reversal of the drive: what keeps the rod from coming back (friction, a strain that
    lags, damping) hides that it does.
    """
    loops, highest = [], max(np.abs(evaluate_lines(s.reading, np.arange(samples) / samples)).max() for s in spectra)
    phases = np.arange(samples) / samples
    coil, mechanics = in_numpy(actuator.coil), in_numpy(actuator.mechanics)
    for s, sigma in zip(spectra, deviations, strict=True):
        applied = coil.applied_field(s.drive_at(phases))
        count = min(len(s.reading), samples // 2 - 1)
        keep = np.abs(s.reading[:count]) > 4 * sigma[:count]
        keep[:3] = True
        w = 2j * np.pi * s.frequency * np.arange(count)
        lines = np.where(keep, s.reading[:count], 0.0)
        if actuator.output == "displacement":
            lines = lines - np.eye(1, count)[0] * float(actuator.sensor.offset)
            gain = mechanics.response(w) if mechanics is not None else np.ones(count)
            lines = np.where(np.abs(gain) > 0.05, lines / gain, 0.0)
            free = evaluate_lines(lines, phases)
            free = free - free.min() if touching and actuator.piezo is None and free.min() < TOUCHING * highest else free
            share, M_s = free / float(actuator.strained.reach), float(actuator.strained.M_s)
            even = actuator.piezo is None  # the strain of a rod hides the sign of M
            M = M_s * (unfold(np.sqrt(np.maximum(share, 0.0)), applied, touching) if even else share - _reversible(actuator, applied))
            rate = np.gradient(np.concatenate([M[-2:], M, M[:2]]))[2:-2] * samples * s.frequency
            H = applied - float(coil.loss) * MU0 * rate
            trust = np.abs(M) / max(np.abs(M).max(), 1e-300) if even else np.ones(samples)
        else:
            B = evaluate_lines(lines, phases)
            H = applied - float(coil.loss) * evaluate_lines(lines * w, phases)
            M = (B / MU0 - H) if actuator.output == "flux_density" else B
            if actuator.piezo is not None:
                M = float(actuator.piezo.V_m) * (B / float(actuator.piezo.P_m) - _reversible(actuator, applied))
            trust = np.ones(samples)
        loops.append((H, M, trust))
    return loops


def _reversible(actuator, voltage):
    """chi V of a stack, as a share of its full scale."""
    return float(actuator.piezo.chi) / float(actuator.piezo.V_m) * voltage


def unfold(root: np.ndarray, drive: np.ndarray, dips: bool = False) -> np.ndarray:
    """The signed M behind |M|, `root`, over a period of equidistant samples: where |M| nearly touches zero it may change sign.

    Of all signs the ones whose M bends least (a change of sign makes a corner of |M| a straight line), found by dynamic
    programming over `SIGNS` instants, which average the noise; M is positive where the drive is largest. `dips`: it changes sign at every
    dip, where a lower drive lies between the two of each pair: between reversals of the drive M goes one way.
    """
    n, top = len(root), int(np.argmax(drive))
    count = min(SIGNS, n)
    edges = np.arange(count + 1) * n // count
    size = np.sqrt(np.add.reduceat(np.roll(root, -top) ** 2, edges[:-1]) / np.diff(edges))
    may = np.append(size, size[:2]) < NEAR_ZERO * size.max()
    if not may.any():
        return root
    if dips and (turns := _dips(size, np.add.reduceat(np.roll(drive, -top), edges[:-1]) / np.diff(edges))):
        return _signed(root, size * np.where(np.searchsorted(turns, np.arange(count), "right") % 2, -1.0, 1.0), edges, top)
    closed = np.append(size, size[:2])
    signs = np.array([1.0, -1.0])
    cost = np.array([[0.0, np.inf], [np.inf, np.inf]])  # [sign before, sign now]; the first two are positive
    came = []
    for k in range(2, count + 2):
        before, now = closed[k - 2] * signs, closed[k - 1] * signs
        bend = (before[:, None, None] - 2 * now[:, None] + closed[k] * signs) ** 2  # [two before, before, now]
        turned = np.where((signs[:, None] == signs) | may[k] | may[k - 1], 0.0, np.inf)
        total = cost[:, :, None] + bend + turned
        came.append(np.argmin(total, axis=0))
        cost = total.min(axis=0)
    path = [0, 0]  # backwards from where it ends, as it began
    for back in came[::-1]:
        path.append(int(back[path[-1], path[-2]]))
    return _signed(root, size * signs[path[::-1][:count]], edges, top)


def _dips(size, drive) -> list[int]:
    """Where |M| comes near zero between lobes, over a period from the largest drive on; [] where these are not pairs with a lower drive
    between the two."""
    near = np.flatnonzero((size <= np.roll(size, 1)) & (size < np.roll(size, -1)) & (size < NEAR_ZERO * size.max()))
    found: list[int] = []
    for k in near.tolist():
        if not found or size[found[-1] : k].max() > max(size[found[-1]], size[k]) + DIPS * size.max():
            found.append(k)
        elif size[k] < size[found[-1]]:  # no lobe between the two: the deeper one
            found[-1] = k
    pairs = zip(found[::2], found[1::2], strict=False)
    lower = all(drive[a + 1 : b].mean() < 0.5 * (drive[a] + drive[b]) for a, b in pairs)  # there is a lobe between the two
    return found if lower and len(found) % 2 == 0 else []


def _signed(root, signed, edges, top):
    """`root`, over a period of equidistant samples, with the signs of some averages of it between `edges`, counted from `top` on."""
    middles = 0.5 * (edges[:-1] + edges[1:] - 1)
    found = np.interp(np.arange(len(root)), middles, signed, period=len(root))
    return root * np.roll(np.where(found < 0, -1.0, 1.0), top)


def agreeing(ranges, turned) -> list[int]:
    """Places of the loops, slowest first, whose M turns its sign or does not as slower ones say; the slowest know best.

    `ranges`: (lowest, highest) drive of each; `turned`: whether its M was found to change sign, which it does in a loop that
    holds one where it does. The resonance's and the eddy currents' start values blur a fast loop's passage through zero.
    """
    kept = []
    for k, (low, high) in enumerate(ranges):
        margin = 0.02 * (high - low)
        inside = [j for j in kept if low <= ranges[j][0] + margin and high >= ranges[j][1] - margin]
        around = [j for j in kept if low >= ranges[j][0] - margin and high <= ranges[j][1] + margin]
        if not (any(turned[j] for j in inside) and not turned[k]) and not (any(not turned[j] for j in around) and turned[k]):
            kept.append(k)
    return kept


def equation_error_start(basis, spectra, deviations, actuator, max_frequency=None, rest=None, touching=False):
    """Density unknowns and the bottom of M from the slower half of the recordings: (x, bottom / total, misfit).

    `max_frequency`: take all recordings (any value but None). `misfit`: rms of the weighted equation error, relative.
    `rest`: field about which the material was demagnetized, A/m; None for negative saturation. `touching`: as of `inferred_loops`.
    """
    order = np.argsort([s.frequency for s in spectra])
    chosen = order[: max(2, (len(order) + 1) // 2)] if max_frequency is None else order
    spectra = [spectra[k] for k in chosen]
    loops = inferred_loops(spectra, [deviations[k] for k in chosen], actuator, touching=touching)
    drives = [s.drive_at(np.arange(200) / 200) for s in spectra]
    turned = [bool(M.min() < 0) for _, M, _ in loops]
    known = agreeing([(d.min(), d.max()) for d in drives], turned)
    if touching and any(turned):  # of a loop that was taken to reach zero and does not turn there, others know better
        known = [k for k in known if turned[k] or loops[k][1].min() > 0]
    loops = [loops[k] for k in known]
    rows, values = [], []
    for H, M, trust in loops:
        step = (basis.high - basis.low) / basis.size
        H = np.clip(H, basis.low + step, basis.high - step)
        Phi = operator_rows(basis, np.tile(H, 2))[len(H) :] + unreached_row(basis, H.max(), H.min(), rest)
        rows.append(np.column_stack([Phi, np.ones(len(H))]) * trust[:, None])
        values.append(M / basis.total * trust)
    A, b = np.concatenate(rows), np.concatenate(values)
    tolerance = 0.01 * (np.abs(b).max() or 1.0)  # a reading of the wrong sign is no strain at all
    A, b = A / tolerance, b / tolerance
    n = basis.unknowns
    normal, gradient = A.T @ A, -A.T @ b
    for weight, D in zip((3.0, 3.0, 30.0, 3.0), basis.penalties, strict=False):
        normal[:n, :n] += (weight * (D.T @ D)).toarray()
    normal += 1e-8 * np.trace(normal) / len(normal) * np.eye(n + 1)
    solution = bounded_minimum(normal, gradient, np.zeros(n + 1), (np.append(np.zeros(n), -np.inf), np.full(n + 1, np.inf)))
    misfit = float(np.sqrt(np.mean((A @ solution - b) ** 2)))
    return np.maximum(solution[:n], 0.0), float(solution[n]), misfit


def scan_loss(basis, spectra, deviations, actuator, name, values):
    """The value of the coil's loss parameter under which all loops are best met by one density: no simulation."""
    misfits = [equation_error_start(basis, spectra, deviations, actuator.replace({name: v}), np.inf)[2] for v in values]
    return float(values[int(np.argmin(misfits))])
