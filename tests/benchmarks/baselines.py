"""What magjax is measured against: a compiled exact loop, diffrax, solve_ivp with a NumPy operator, a NumPy relay grid."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from magjax.inverse import PlainPreisach
from magjax.inverse.accelerated import trapezoid_march

MU0 = 4e-7 * np.pi


def plain(actuator) -> PlainPreisach:
    """The actuator's operator in NumPy."""
    h = actuator.hysteresis
    return PlainPreisach(np.asarray(h.masses), float(h.low), float(h.high), float(h.offset))


def compiled_loop(actuator, applied, dt):
    """The trapezoid by the exact walk, compiled by numba: (H, M)."""
    return trapezoid_march(plain(actuator), applied, MU0 * float(actuator.coil.loss) / dt)


def numpy_relay_grid(actuator, applied, dt):
    """The same step with an L x L array of point relays and brentq."""
    h = actuator.hysteresis
    masses, L = np.asarray(h.masses), h.cells
    levels = float(h.low) + (float(h.high) - float(h.low)) * (np.arange(L) + 0.5) / L
    state = -np.ones_like(masses)
    a = MU0 * float(actuator.coil.loss) / dt

    def switched(v):
        return np.where(v >= levels[:, None], 1.0, np.where(v <= levels[None, :], -1.0, state))

    def M_of(v):
        return float(h.offset) + (masses * switched(v)).sum()

    H = applied[0]
    state = switched(H)
    M, rows = M_of(H), [H]
    for k in range(1, len(applied)):
        rhs = a * (H + M) - 0.5 * H + 0.5 * (applied[k - 1] + applied[k])
        residual = lambda v: (0.5 + a) * v + a * M_of(v) - rhs  # noqa: E731
        low, high = H - 5e4, H + 5e4
        H = brentq(residual, low, high, xtol=1e-6)
        state = switched(H)
        M = M_of(H)
        rows.append(H)
    return np.array(rows)


def solve_ivp_numpy(actuator, applied, dt):
    """LSODA on dH/dt = c1/c0 (applied - H)/(1 + dM/dH), the slope by a difference on a NumPy operator."""
    operator = plain(actuator)
    k = 1 / (MU0 * float(actuator.coil.loss))
    t = dt * np.arange(len(applied))
    operator.apply(applied[0])

    def rate(time, state):
        drive = np.interp(time, t, applied)
        sign = 1.0 if drive >= state[0] else -1.0
        probe = operator.copy()
        m0 = probe.apply(state[0])
        slope = (probe.apply(state[0] + sign) - m0) * sign
        return [k * (drive - state[0]) / (1 + max(slope, 0.0))]

    H, rows = applied[0], [applied[0]]
    for n in range(1, len(t)):  # the memory moves on between samples
        H = float(solve_ivp(rate, (t[n - 1], t[n]), [H], method="LSODA", rtol=1e-6, atol=1e-3).y[0, -1])
        operator.apply(H)
        rows.append(H)
    return np.array(rows)


def diffrax_solver(actuator, applied, dt):
    """A compiled diffrax solve (Kvaerno3, adaptive) of the same equation on each step, the memory carried: a closure."""
    import diffrax
    import jax
    import jax.numpy as jnp

    from magjax.preisach.memory import apply_field, saturated_memory

    table = actuator.hysteresis.table()
    k = 1 / (MU0 * actuator.coil.loss)

    def rate(time, H, args):
        memory, before, after = args
        drive = before + (after - before) * time / dt
        moved, slope = jax.jvp(lambda v: apply_field(table, memory, v).magnetization, (H,), (jnp.ones_like(H),))
        return k * (drive - H) / (1 + slope)

    def advance(carry, pair):
        memory, H = carry
        before, after = pair
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(rate), diffrax.Kvaerno3(), 0.0, dt, dt, H, args=(memory, before, after),
            stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-3), max_steps=256,
        )  # fmt: skip
        H = solution.ys[0]
        return (apply_field(table, memory, H), H), H

    @jax.jit
    def run(applied):
        start = apply_field(table, saturated_memory(table, 4), applied[0])
        return jax.lax.scan(advance, (start, applied[0]), (applied[:-1], applied[1:]))[1]

    applied = jnp.asarray(applied)
    return lambda: run(applied)
