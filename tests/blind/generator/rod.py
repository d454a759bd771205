"""The rod as an oscillator, (5), in its periodic steady state: by harmonics where linear, by Newmark's steps where not."""

import numpy as np

from .strain import FULL, M_S

RELAXED = 6  # rounds, each about a tenth of the one before


def response(x, frequency, law):
    """A linear `law(s)` on one period (recordings, steps) of the fundamentals `frequency` (recordings,) in Hz."""
    s = 2j * np.pi * frequency[:, None] * np.arange(x.shape[1] // 2 + 1)
    return np.fft.irfft(np.fft.rfft(x, axis=1) * law(s), x.shape[1], axis=1)


def displacement(free, M, frequency, truth, effects):
    """y, m, from the free displacement, m, one settled period each."""
    w, xi = 2 * np.pi * truth["f0"], truth["xi"]
    eta, alpha = effects.get("structural_damping", 0.0), 0.12

    def loss(s):
        # fractional Kelvin: a nearly flat phase
        return eta * ((s / w) ** alpha - 1) * (s != 0) / np.sin(0.5 * np.pi * alpha) if eta else 0.0

    if {"duffing_stiffness", "delta_e", "coulomb_friction", "end_stop"} & set(effects):
        y = _newmark(free, M, frequency, w, xi, effects)
        for _ in range(RELAXED if eta else 0):  # its force by waveform relaxation: it is small beside the stiffness
            y = _newmark(free - response(y, frequency, loss), M, frequency, w, xi, effects)
    else:
        y = response(free, frequency, lambda s: 1 / (1 + loss(s) + 2 * xi * s / w + (s / w) ** 2))
    if "second_mode" in effects:
        w2, xi2 = 2 * np.pi * truth.get("f2", 1000.0), truth.get("xi2", 0.04)
        y = y + effects["second_mode"] * response(free, frequency, lambda s: 1 / (1 + 2 * xi2 * s / w2 + (s / w2) ** 2))
    if "creep" in effects:  # logarithmic compliance, Kelvin elements without end
        tail = lambda s: np.log1p(1 / (np.where(s == 0, 0.06j, s) * 1e-4)) / np.log(10)
        y = y + effects["creep"] * response(y, frequency, lambda s: np.where(s == 0, 0, tail(s) - 2.0))
    if "subharmonic" in effects:  # in no catalogue: every second period differs (a rattling joint)
        y = np.concatenate([y * (1 + effects["subharmonic"]), y * (1 - effects["subharmonic"])], axis=1)
    return y


def _newmark(free, M, frequency, w, xi, effects, settle=6):
    """Average acceleration with Newton on the nonlinear springs, LuGre's bristle in its implicit form; the last period."""
    d, e = effects.get("duffing_stiffness", 0.0), effects.get("delta_e", 0.0)
    friction, stop = effects.get("coulomb_friction", 0.0) * FULL, effects.get("end_stop", 0.0)
    steps = free.shape[1]
    h = 1 / (frequency * steps)
    y, v, z = free[:, 0].copy(), np.zeros(len(free)), np.zeros(len(free))
    a = np.zeros(len(free))
    softening = 1 / (1 + e * (1 - (M / M_S) ** 2)) if e else np.ones_like(M)  # modulus lost to turning moments
    out = np.empty_like(free)
    presliding, slow = 0.006 * FULL, 2e-5  # m, m/s (Stribeck)
    for _turn in range(settle + 1):
        for n in range(steps):
            k, u = softening[:, n], free[:, n]
            new = y + h * v + 0.25 * h * h * a * 2
            for _ in range(40):
                acc = 4 * (new - y - h * v) / h**2 - a
                vel = v + 0.5 * h * (a + acc)
                r = new / FULL
                spring, stiff = k * new + d * new * r**2 / (1.2 - r**2), k + d * (3.6 * r**2 - r**4) / (1.2 - r**2) ** 2
                over = np.maximum(new - 0.3 * FULL, 0)
                spring, stiff = spring + stop * over, stiff + stop * (over > 0)
                drag, slope = 0.0, 0.0
                if friction:
                    level = 1 + 0.25 * np.exp(-((vel / slow) ** 2))
                    bristle = (z + h * vel) / (1 + h * np.abs(vel) / (presliding * level))
                    drag, slope = friction * bristle / presliding, 0.5 * friction / presliding
                residual = acc / w**2 + 2 * xi / w * vel + spring + drag - u
                change = residual / (4 / (h * w) ** 2 + 4 * xi / (w * h) + stiff + slope)
                new = new - change
                if np.abs(change).max() < 1e-14:
                    break
            acc = 4 * (new - y - h * v) / h**2 - a
            vel = v + 0.5 * h * (a + acc)
            if friction:
                level = 1 + 0.25 * np.exp(-((vel / slow) ** 2))
                z = (z + h * vel) / (1 + h * np.abs(vel) / (presliding * level))
            y, v, a = new, vel, acc
            out[:, n] = y
    return out
