"""The source judged by itself: commanded against measured current, on the device's one clock. No model of the rod is needed.

A first-order amplifier gives current / command = g / (1 + i w tau) at the drive's frequency; a pure delay g exp(-i w tau) is its
rival. Both are fitted to the fundamentals of all recordings; what is left is told in units of the noise.
"""

import numpy as np

from ..instruments import judge_source
from .log import read_log


def fundamental_gain(table: dict, metadata: dict):
    """(w in rad/s, current over command at the drive's frequency, its standard error); None where either is missing."""
    frequency, rate = metadata.get("frequency_Hz"), metadata.get("rate_Hz")
    if not frequency or not rate or metadata.get("current") != "measured" or "command_A" not in table or metadata["lost_samples"]:
        return None
    width = round(rate / frequency)
    periods = len(table["time_s"]) // width
    if periods < 2 or abs(width * frequency / rate - 1) > 1e-6:
        return None
    command, current = (np.asarray(table[c])[: periods * width].reshape(periods, width) for c in ("command_A", "current_A"))
    turn = np.exp(-2j * np.pi * np.arange(width) / width) * 2 / width
    lines = current @ turn
    scatter = np.sqrt(np.mean(np.var(current, axis=0, ddof=1)) * 2 / current.size)
    quantum = np.abs(np.diff(np.unique(current))).min() if np.ptp(current) else 0.0
    drive = (command @ turn).mean()
    error = max(scatter, quantum / np.sqrt(12) * np.sqrt(2 / current.size)) / abs(drive)
    return 2 * np.pi * frequency, lines.mean() / drive, error


def check_source(files) -> dict | None:
    """The amplifier by its own recordings: verdict "follows", "amplifier_lag", "delay", "group" or "unknown"; tau; who decided it.

    None where no recording holds both the command and a measured current.
    """
    found = []
    for file in files:
        for table, metadata in read_log(file):
            point = fundamental_gain(table, metadata)
            if point is not None:
                found.append((str(file), *point))
    if len(found) < 2:
        return None
    w, gain, error = (np.array([f[k] for f in found]) for k in (1, 2, 3))
    verdict, best, rival = judge_source(w, gain, error)
    turned = np.abs(np.angle(gain / best.gain)) / error
    order = np.argsort(-turned)
    decided = [{"file": found[k][0], "frequency_Hz": float(w[k] / 2 / np.pi), "phase_deg": float(np.degrees(np.angle(gain[k]))), "z": float(turned[k])}
               for k in order]  # fmt: skip
    tau, stderr = best.parameters["tau"]
    return {
        "verdict": verdict, "tau": tau, "stderr": stderr, "z": best.z, "gain": best.gain, "chi2": best.chi2,
        "numbers": best.numbers, "rival_chi2": rival, "decided_by": decided,
    }  # fmt: skip
