"""Where the misfit sits: by recording, harmonic, branch, field region, period and block."""

import numpy as np

from .joint import data_residual
from .spectra import evaluate_lines


def where(result, candidates, recordings, output) -> dict:
    """The map of the misfit as plain numbers: chi2 per datum by recording and harmonic, rms by branch, field, period."""
    problem, solution = result.problem, result.solution
    residual = data_residual(problem, solution.z)
    R, H = problem.target.lines.shape
    real, imag = residual[: R * H].reshape(R, H), np.zeros((R, H))
    imag[:, 1:] = residual[R * H :].reshape(R, H - 1)
    power = real**2 + imag**2
    count = np.where(np.arange(H) == 0, 1, 2)
    deviation = np.where(np.isfinite(problem.target.deviations), problem.target.deviations, 0.0)
    phases = np.arange(256) / 256
    rising, falling, turning, field, period = [], [], [], [[] for _ in range(4)], []
    for k, s in enumerate(problem.spectra):
        misfit = evaluate_lines((real[k] + 1j * imag[k]) * deviation[k], phases)
        drive = s.drive_at(phases)
        slope = np.gradient(drive)
        fast = np.abs(slope) > 0.3 * np.abs(slope).max()
        rising.append(misfit[(slope > 0) & fast])
        falling.append(misfit[(slope < 0) & fast])
        turning.append(misfit[~fast])
        share = np.clip(((drive - drive.min()) / np.ptp(drive) * 4).astype(int), 0, 3)
        for q in range(4):
            field[q].append(misfit[share == q])
        y = np.asarray(recordings[k].channels[output])[: s.samples] - evaluate_lines(
            s.reading, np.arange(s.samples) * s.dt * s.frequency
        )
        period.append([float(np.sqrt(np.mean(b**2))) for b in np.array_split(y, s.periods)])

    def rms(parts):
        return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))

    above = above_noise(float(power.sum()), result.data_count)
    blocks = {}
    for c in candidates:  # the best first: of blocks that take all, the first named is the one whose effect scores highest
        blocks[c.block] = max(blocks.get(c.block, 0.0), min(c.predicted_chi2_drop / above, 1.0))
    return {
        "by_recording": {r.file.rsplit("/", 1)[-1]: r.chi2_per_sample for r in result.recordings},
        "by_harmonic": [float(v) for v in power.sum(axis=0) / (R * count)],
        "by_branch": {"rising": rms(rising), "falling": rms(falling), "turning": rms(turning)},
        "by_field": [rms(f) for f in field],
        "by_period": period,
        "by_block": blocks,
    }


def above_noise(chi2: float, count: int) -> float:
    """What of chi2 over `count` numbers is above the noise: at least one standard deviation of what noise alone would give."""
    return max(chi2 - count, float(np.sqrt(2 * count)))
