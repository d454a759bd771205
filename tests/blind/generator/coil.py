"""The coil and the rod's field, (4): H_app - H = K dB/dt, B = mu0 (H + M), by the second-order backward formula.

H_app = H_bias + c0 I, K = c0 N_m A_m / R_eddy. Concealed effects act in the same implicit step. The rod may be cut into shells of
equal area with their own field and relays; K is then the matrix of Ampere's law in a cylinder, of the same mean.
"""

import numpy as np

MU0 = 4e-7 * np.pi
TURNS, AREA, C0 = 1300, 2.83e-5, 1.54e4
LAGS = np.logspace(-3.5, 1.0, 10)  # s, after-effect


def shell_matrix(count):
    """Symmetric (count, count) matrix of mean 1: H lost in shell i for a unit dB/dt in shell j."""
    fine = 60 * count
    area = (np.arange(fine) + 0.5) / fine  # r^2 / R^2
    outer = np.maximum.outer(area, area)
    kernel = -np.log(outer)  # integral from max(r, r') to R of dr/r, doubled
    kernel = kernel.reshape(count, 60, count, 60).mean(axis=(1, 3))
    return kernel / kernel.mean()


class FieldSolver:
    """Marches all recordings of a bench side by side. `effects`: name -> strength."""

    def __init__(self, density, R_eddy, effects):
        self.density, self.effects = density, effects
        k = C0 * TURNS * AREA / R_eddy
        share = effects.get("field_diffusion", 0.0)
        self.shells = 5 if share else 1
        self.K = k / self.shells * ((1 - share) + share * shell_matrix(self.shells)) if share else np.array([[k]])
        self.mean = effects.get("mean_field", 0.0)
        self.chi = effects.get("reversible_magnetization", 0.0)
        self.viscosity = effects.get("magnetic_aftereffect", 0.0)
        self.excess = effects.get("excess_loss", 0.0)
        self.thermal = effects.get("rate_dependent_switching", 0.0)
        self.bowing = effects.get("wall_bowing", 0.0)

    def solve(self, applied, h, state, pull=None, settle=6):
        """M and H of the last period, (recordings, steps).

        `applied` (recordings, steps) one period of H_app; `h` (recordings,) s; `state` the start memory; `pull` (recordings,
        steps) multiplies M in the field that the relays see (stress).
        """
        count, steps = applied.shape
        self.h = h[:, None]
        self.decay = np.exp(-self.h[..., None] / LAGS)
        pull = np.zeros_like(applied) if pull is None else pull
        H = np.repeat(applied[:, :1], self.shells, axis=1)
        self.plays, M, _ = self.density.evaluate(self.density.start(H.shape, state), H)
        self.relays, self.seen, seen_old = M, H, H
        self.late, self.extra = np.repeat(M[..., None], len(LAGS), axis=-1), np.zeros_like(H)
        M = self._total(M, H)[0]
        H_old, M_old = H, M
        sweep = np.abs(np.roll(applied, -1, axis=1) - np.roll(applied, 1, axis=1)) / (2 * self.h)
        rows = np.empty((2, steps, count))
        for turn in range(settle + 1):
            weighed = np.zeros_like(self.late)
            for n in range(steps):
                target = applied[:, (n + 1) % steps][:, None]
                if self.thermal:  # coercive field grows with the logarithm of the sweep rate
                    self.extra = self.thermal * np.log1p(np.repeat(sweep[:, (n + 1) % steps, None], self.shells, axis=1) / 1e4)
                past = MU0 * (2 * (H + M) - 0.5 * (H_old + M_old))
                guess, seen_old = 2 * self.seen - seen_old, self.seen
                new, total = self._step(M, guess, target, past, pull[:, (n + 1) % steps][:, None])
                H_old, M_old, H, M = H, M, new, total
                rows[:, (n + 1) % steps] = H.mean(axis=1), M.mean(axis=1)
                if self.viscosity:
                    self.late = self.decay * self.late + (1 - self.decay) * self.relays[..., None]
                    weighed = self.decay * weighed + (1 - self.decay) * self.relays[..., None]
            if self.viscosity and turn < settle:  # lags stand where this period would repeat
                self.late = weighed / (1 - self.decay**steps)
        return rows[1].T, rows[0].T

    def _total(self, M, H):
        """Magnetization with its reversible and late parts, and d(total)/dM, d(total)/dH."""
        a = 2e4
        keep = 1.0
        total = M
        if self.viscosity:
            keep = 1 - self.viscosity * self.decay.mean(axis=-1)
            total = keep * M + self.viscosity * (self.decay * self.late).mean(axis=-1)
        if self.chi:
            return total + self.chi * a * np.tanh(H / a), keep, self.chi / np.cosh(H / a) ** 2
        return total, keep, 0.0

    def _step(self, M, guess, target, past, pull):
        h, seen = self.h, guess  # the field that the relays see is the unknown
        lift = self.mean + pull
        K = self.K
        if self.bowing:  # eddy currents of bowed walls: less where M is high
            K = (self.K[0, 0] * (1 - self.bowing * (M / 7.87e5) ** 2))[:, :, None]
        kept, step, best = seen, np.zeros_like(seen), np.full(len(seen), np.inf)
        share = np.ones(len(seen))
        for _ in range(80):  # Newton's steps, halved for each recording whose residual grows
            plays, relays, slope = self.density.evaluate(self.plays, seen, self.extra)
            v, own = seen - lift * relays, 1 - lift * slope
            total, keep, direct = self._total(relays, v)
            rate = (1.5 * MU0 * (v + total) - past) / h
            gain = 1.5 * MU0 / h * (keep * slope + own * (1 + direct))
            residual = v + (K @ rate[..., None])[..., 0] - target
            jacobian = np.eye(self.shells) * own[:, :, None] + K * gain[:, None, :]
            if self.excess:  # Bertotti 1988: V0 and n0 form, sqrt only at high rates
                root = np.sqrt(3.0 + np.abs(rate))
                residual = residual + self.excess * np.sign(rate) * (root - np.sqrt(3.0))
                jacobian = jacobian + (0.5 * self.excess / root * gain)[:, :, None] * np.eye(self.shells)
            size = np.abs(residual).max(axis=1)
            if size.max() < 1e-7:
                self.plays, self.relays, self.seen = plays, relays, seen
                return v, total
            better = size < best
            fresh = residual / jacobian[..., 0] if self.shells == 1 else np.linalg.solve(jacobian, residual[..., None])[..., 0]
            kept, step = np.where(better[:, None], seen, kept), np.where(better[:, None], fresh, step)
            best, share = np.where(better, size, best), np.where(better, 1.0, 0.5 * share)
            seen = kept - share[:, None] * step
        raise RuntimeError(f"a field step did not settle: {size.max():.1e} A/m left")
