"""A concealed bench: current to displacement by the equations of T&B, with effects by laws of their own.

Written from the paper: (4) by the trapezoid on a fine grid with Newton steps, the rod as an oscillator stepped exactly
(or by small implicit steps where it is nonlinear). All recordings of a bench march side by side.
"""

import numpy as np

from .hysteresis import Plays

MU0 = 4e-7 * np.pi
TURNS, AREA, C0, M_S, LENGTH, LAMBDA_S = 1300, 2.83e-5, 1.54e4, 7.87e5, 5.13e-2, 1.313e-3
FINE = 500  # steps a period
SETTLE = 5
PERIODS = 4


class ConcealedBench:
    """`truth`: R_eddy, f0, xi, H_bias; `effects`: name -> strength by the laws below; `density`: kind of the plays."""

    def __init__(self, truth, effects, density, start, rng):
        self.truth, self.effects, self.start = truth, dict(effects), start
        low, high = truth["H_bias"] - 1.02 * C0, truth["H_bias"] + 1.02 * C0
        self.plays = Plays(density, low, high, 0.8 * M_S, rng)
        self.level = 0.19 * M_S  # what is saturated below the plane

    def currents(self, drives, steps=FINE):
        """Command of each recording over settling and recorded periods: (recordings, time) and the steps' lengths."""
        count = (SETTLE + PERIODS) * steps + 1
        phase = np.arange(count) / steps
        rows = []
        for d in drives:
            signal = d["offset"] + d["amplitude"] * np.sin(2 * np.pi * phase)
            for order, share, angle in d.get("extra", ()):
                signal = signal + share * d["amplitude"] * np.sin(2 * np.pi * order * phase + angle)
            rows.append(signal)
        return np.array(rows), np.array([1 / (d["frequency"] * steps) for d in drives])

    def run(self, drives, steps=FINE):
        """Displacement reading and coil current of the recorded periods, (recordings, PERIODS * steps), SI."""
        command, h = self.currents(drives, steps)
        current = command
        if "amplifier_lag" in self.effects:
            current = _lag(command, h, self.effects["amplifier_lag"])
        H, M = self._field(C0 * current + self.truth["H_bias"], h)
        M = M + self.level
        free = self._strain(M, H)
        y = self._rod(free, M, h)
        y = self._sensor(y, current, h, drives, steps)
        last = PERIODS * steps
        return y[:, -last - 1 : -1], (current if "amplifier_lag" not in self.effects else command)[:, -last - 1 : -1]

    def _field(self, applied, h):
        k = C0 * TURNS * AREA / self.truth["R_eddy"]
        e = self.effects
        mean = e.get("mean_field", 0.0)
        viscosity = e.get("magnetic_aftereffect", 0.0)
        excess = e.get("excess_loss", 0.0)
        a = MU0 * k / h
        H = applied[:, 0].copy()
        plays = self.plays.start(H, self.start)
        M = self.plays.magnetization(plays)
        late = np.array([M * viscosity / 4] * 4)
        times = np.array([2e-4, 2e-3, 2e-2, 2e-1])[:, None]
        decay = np.exp(-h / times)
        out_H, out_M = [H], [M]
        seen = H + mean * M  # what the relays see
        X_late = late.sum(axis=0) if viscosity else 0.0
        for n in range(1, applied.shape[1]):
            rhs = a * (H + M) - 0.5 * H + 0.5 * (applied[:, n] + applied[:, n - 1])
            v, m = H.copy(), M
            low, high = H - 2 * C0, H + 2 * C0
            for trial in range(90):
                relay = v + mean * m - viscosity * X_late
                new = self.plays.move(plays, relay)
                m_new = self.plays.magnetization(new)
                slope = self.plays.slope(new, plays, relay)
                slope = slope / np.maximum(1 - mean * slope, 0.2)
                residual = 0.5 * v + a * (v + m_new) - rhs
                total = 0.5 + a * (1 + slope)
                if excess:
                    rate = MU0 * (v + m_new - H - M) / h
                    # Bertotti's field with a number of correlation regions that grows with it
                    field = excess * np.sign(rate) * (np.sqrt(4.0 + np.abs(rate)) - 2.0)
                    residual = residual + field
                    total = total + excess * 0.5 / np.sqrt(4.0 + np.abs(rate)) * MU0 * (1 + slope) / h
                low, high = np.where(residual <= 0, v, low), np.where(residual > 0, v, high)
                if np.abs(residual / total).max() < 1e-8:
                    break
                better = v - residual / total
                inside = (better > low) & (better < high) & (trial % 5 != 4)  # else halve: Newton may cycle over a kink
                better = np.where(inside, better, 0.5 * (low + high))
                v, m = np.where(residual == 0, v, better), m_new
            else:
                raise RuntimeError("a field step did not settle")
            seen = v + mean * m - viscosity * X_late
            plays = self.plays.move(plays, seen)
            H, M = v, self.plays.magnetization(plays)
            if viscosity:
                late = late * decay + (1 - decay) * M / 4
                X_late = late.sum(axis=0)
            out_H.append(H)
            out_M.append(M)
        return np.array(out_H).T, np.array(out_M).T

    def _strain(self, M, H):
        m2 = (M / M_S) ** 2
        free = m2 + self.effects.get("quartic_magnetostriction", 0.0) * (m2**2 - m2)
        free = free + self.effects.get("linear_strain", 0.0) * M / M_S
        return LENGTH * LAMBDA_S * free

    def _rod(self, free, M, h):
        w, xi = 2 * np.pi * self.truth["f0"], self.truth["xi"]
        e = self.effects
        nonlinear = {"duffing_stiffness", "delta_e", "coulomb_friction"} & set(e)
        if not nonlinear:
            y = _oscillator(free, h, w, xi)
            if "second_mode" in e:
                y = y + e["second_mode"] * _oscillator(free, h, 2 * np.pi * 900.0, 0.04)
        else:
            y = self._stiff_rod(free, M, h, w, xi)
        if "structural_damping" in e:
            y = _filter(y, h, lambda s: 1 / (1 + 1j * e["structural_damping"] * np.tanh(s.imag / 10)))
        if "creep" in e:
            y = y + e["creep"] * sum(_lag(y, h, t) - y.mean() for t in (3e-3, 3e-2, 3e-1)) / 3
        return y

    def _stiff_rod(self, free, M, h, w, xi):
        """Newmark steps (average acceleration) with the nonlinear forces iterated; Dahl's friction with a bristle."""
        e = self.effects
        y, v = free[:, 0].copy(), np.zeros(len(free))
        bristle = np.zeros_like(y)
        scale = LENGTH * LAMBDA_S
        coulomb, presliding = e.get("coulomb_friction", 0.0) * scale, 0.02 * scale

        def pull(y, m):
            stiffness = 1 + e.get("delta_e", 0.0) * ((m / M_S) ** 2 - 0.3)
            return stiffness * y + e.get("duffing_stiffness", 0.0) * y**3 / scale**2

        acc = w * w * (free[:, 0] - pull(y, M[:, 0]))
        rows = [y]
        for n in range(1, free.shape[1]):
            new = y + h * v + 0.5 * h * h * acc
            a1 = acc
            for _ in range(6):
                v1 = v + 0.5 * h * (acc + a1)
                step = new - y
                b1 = (bristle + step) / (1 + np.abs(step) / presliding) if coulomb else bristle
                a1 = w * w * (free[:, n] - pull(new, M[:, n]) - 2 * xi / w * v1 - coulomb * b1 / presliding)
                guess = y + h * v + 0.25 * h * h * (acc + a1)
                new = guess
            bristle, y, v, acc = b1, new, v + 0.5 * h * (acc + a1), a1
            rows.append(y)
        return np.array(rows).T

    def _sensor(self, y, current, h, drives, steps):
        e = self.effects
        if "sensor_lag" in e:  # second-order Butterworth
            w = 2 * np.pi * e["sensor_lag"]
            y = _filter(y, h, lambda s: w * w / (s * s + np.sqrt(2) * w * s + w * w))
        if "transport_delay" in e:
            y = _filter(y, h, lambda s: np.exp(-s * e["transport_delay"]))
        if "inductive_crosstalk" in e:
            y = y + e["inductive_crosstalk"] * np.gradient(current, axis=1) / h[:, None]
        if "sensor_nonlinearity" in e:
            y = y - e["sensor_nonlinearity"] * y**2 / (LENGTH * LAMBDA_S)
        last = PERIODS * steps
        t = np.arange(y.shape[1]) - (y.shape[1] - 1 - last)
        time = t * h[:, None]
        if "zero_drift" in e:
            y = y + e["zero_drift"] * time
        if "thermal_drift" in e:  # two nodes: coil and rod
            heat = (current**2).mean(axis=1)[:, None]
            y = y + e["thermal_drift"] * heat * (1 - 0.7 * np.exp(-np.maximum(time, 0) / 2.0) - 0.3 * np.exp(-np.maximum(time, 0) / 20.0)) * (time > 0)
        if "mains_hum" in e:
            y = y + e["mains_hum"] * np.sin(2 * np.pi * 50.0 * time + np.arange(len(y))[:, None])
        if "hidden_bump" in e:  # in no catalogue: a local kink of the displacement
            y = y + e["hidden_bump"] * np.exp(-0.5 * ((y - y.mean(axis=1, keepdims=True)) / 3e-6) ** 2) * np.sign(np.gradient(y, axis=1))
        return y


def _lag(x, h, tau):
    """First-order lag by exact steps with a straight input between samples."""
    r = h / tau
    decay = np.exp(-r)
    slope = (1 - decay) / r
    out = np.empty_like(x)
    out[:, 0] = x[:, 0]
    for n in range(1, x.shape[1]):
        out[:, n] = decay * out[:, n - 1] + (slope - decay) * x[:, n - 1] + (1 - slope) * x[:, n]
    return out


def _filter(y, h, response):
    """A linear response on the recorded periods, which repeat."""
    last = y.shape[1] - 1
    count = PERIODS * round(last / (SETTLE + PERIODS))
    tail = y[:, -count - 1 : -1]
    spectrum = np.fft.rfft(tail, axis=1)
    for k in range(len(y)):
        spectrum[k] *= response(2j * np.pi * np.fft.rfftfreq(count, h[k]))
    new = y.copy()
    new[:, -count - 1 : -1] = np.fft.irfft(spectrum, count, axis=1)
    new[:, -1] = new[:, -count - 1]
    return new


def _oscillator(u, h, w, xi):
    """y'' + 2 xi w y' + w^2 y = w^2 u by the exact transition for a straight input between samples."""
    from scipy.linalg import expm

    y = np.empty_like(u)
    for k in range(len(u)):
        A = np.zeros((4, 4))
        A[0, 1] = 1
        A[1, :3] = -w * w, -2 * xi * w, w * w
        A[2, 3] = 1
        E = expm(A * h[k])
        from scipy.signal import lfilter

        # two states to one recursion: y_n = tr y_(n-1) - det y_(n-2) + input terms
        P, B0, B1 = E[:2, :2], E[:2, 2], E[:2, 3] / h[k]
        x = u[k] - u[k, 0]
        drive = np.outer(B0 - B1, np.append(x[:-1], 0))[:, :-1] + np.outer(B1, x[1:])
        tr, det = np.trace(P), np.linalg.det(P)
        g = np.zeros((2, len(x)))
        g[:, 1:] = drive
        forced = g[0].copy()
        forced[1:] += P[0, 1] * g[1, :-1] - P[1, 1] * g[0, :-1]
        y[k] = lfilter([1.0], [1.0, -tr, det], forced) + u[k, 0]
    return y
