"""The coupled step where the field diffuses into the rod: shells with their own field and relays.

A rod of S depths, each with a field v_i and a Preisach operator of its own, all with the same masses: the nodes of Gauss and
Legendre in u = (r/R)^2, each for a shell of its weight w_i of the area. By Ampere's and Faraday's laws in a cylinder
H(u) = applied field - k int -2 ln max(u, u') dB(u')/dt du', of which a polynomial through the nodes makes
H_i = applied field - k sum_j D_ij w_j dB_j/dt, D symmetric; its mean is one, so that the mean lag is that of (4). One step asks for
    p0 (v_i + shift_i) + loss_i + sum_j Q_ij X_j = rhs_i,   X_j = H_j + M_j,
    p0 = 1, Q_ij = 3/2 a D_ij w_j for the backward formula, p0 = 1/2, Q_ij = a D_ij w_j for the trapezoid (a = mu0 k / h):
with row i times w_i the gradient of a strictly convex function of the X_j, piecewise quadratic. It is solved by Newton's method
with shortened steps; one more step with a frozen matrix makes every derivative exact, as in `coupled`.
Means over the section go to the blocks behind: what the coil sees and what the rod does as a whole. Its sections stay plane,
so that it strains by the mean of M^2: by the square of the mean M and the variance of M over the section, its spread (but for what `alike` takes off it).
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient

from ..constants import MU0
from ..effects.base import Trial
from ..linear import inverse_of_definite
from ..preisach.memory import apply_field, branch_magnetization
from .closed_form import slope_of
from .coupled import March, _settle, run_march
from .loops import tied
from .newton import extra_terms

CLOSE_ENOUGH = 1e-10  # A/m relative to half the plane
MOST_STEPS = 400  # on rough densities some of a march take more than a hundred
OVERSHOOT = 0.5  # of the descent at a step's start, that its end may climb; else the step is shortened to where it would not climb,
SHORTER = 0.2, 0.7  # to this share of it at least and at most


@functools.cache
def distribution(count: int) -> tuple[np.ndarray, np.ndarray]:
    """(D, w): field lost at a depth per k dB/dt of another, (count, count), symmetric; and what each is of the area, (count,). w'D w = 1.

    Polynomials through the nodes are integrated exactly. Of a rod of one permeability four nodes miss 1e-8 of the loss where its depth
    of penetration is the radius over two, and 6e-4 at a sixth of it, where four shells of equal area miss 1e-2.
    """
    nodes, weights = np.polynomial.legendre.leggauss(count)
    nodes, weights, order = (nodes + 1) / 2, weights / 2, np.arange(1, count + 1)
    of_powers = 2 * (1 - nodes[:, None] ** order) / order**2  # integral of -2 ln max(u, u') u'^(order - 1)
    D = of_powers @ np.linalg.inv(np.vander(nodes, increasing=True)) / weights
    return (D + D.T) / 2, weights


class _Carry(eqx.Module):
    memory: object  # of every shell
    X0: jax.Array
    X_before: jax.Array
    H0: jax.Array
    applied0: jax.Array
    states: tuple
    marks: tuple


def march_shells(actuator, share, count: int, applied, current, h, memory, scheme: str, disturbance=None, period: int = 0):
    """`march.magnetize` for a rod of `count` depths, of whose loss a `share` is distributed as in a solid cylinder."""
    march = march_of_shells(actuator, share, count, applied[0], current[0], h, memory, scheme, period)
    return run_march(march, applied, current, disturbance, period)


def march_of_shells(actuator, share, count: int, applied, current, h, memory, scheme: str, period: int = 0) -> March:
    """`coupled.march_of` for such a rod."""
    table = actuator.hysteresis.table()
    rod = _rod(actuator, share, count, h, scheme, period)
    memory = jax.vmap(lambda _: apply_field(table, memory, applied))(jnp.arange(count))
    carry, M = rested_shells(rod, actuator, applied, current, h, memory)

    def advance(c: _Carry, drive):
        rhs, trial_of = rod.posed(c, drive)
        v, m, rising, kept = _solve(table, c, rod, actuator, trial_of, drive[1], rhs)
        moved = jax.vmap(lambda s, r, k, x, y: s.move(r, k, x, y))(c.memory, rising, kept, v, m)
        unlike = _relays(table, c.memory, v)[0] - m  # the relays' own M there: a step that did not settle shows
        return rod.after(c, drive, v, m, moved, unlike)

    zero = jnp.zeros_like(memory.field)
    return March(carry, (carry.H0, M, zero, memory.field, zero), advance)


class _Rod(NamedTuple):
    """One step of a rod in shells apart from how it is solved, as `coupled._Law`: p0 (v + shift) + loss + Q X = rhs; `weights`: of the shells.

    `posed(carry, drive)`: (rhs, trial of (carry, current, v, m)); `after(carry, drive, v, m, memory, unlike)`: (next carry, row).
    """

    effects: tuple
    p0: float
    Q: jax.Array
    weights: np.ndarray
    posed: object
    after: object


def _rod(actuator, share, count, h, scheme, period) -> _Rod:
    effects = tuple(e for e in actuator.effects if e.in_step and not e.shells)
    bdf = scheme == "bdf2"
    a = MU0 * actuator.coil.loss / h
    D, weights = distribution(count)
    D = (1 + share * (D - 1)) * weights
    seen = next((1 - e.alike for e in actuator.effects if e.shells), 1.0)
    p0, Q = (1.0, 1.5 * a * D) if bdf else (0.5, a * D)

    def trial_of(c, current, v, m):
        X1 = v + m
        change = (1.5 * X1 - 2 * c.X0 + 0.5 * c.X_before) if bdf else X1 - c.X0
        return Trial(v, m, MU0 * change / h, (v - c.memory.field) / h, current, h)

    def posed(c, drive):
        applied1, _, _, *given = drive
        if bdf:
            rhs = applied1 + (Q / 1.5) @ (2 * c.X0 - 0.5 * c.X_before)
        else:
            rhs = 0.5 * (applied1 + c.applied0 - c.H0) + Q @ c.X0
        if given:  # p = p0 + q there: what is added to H acts on the loss too
            rhs = rhs - p0 * given[0] - Q @ (jnp.ones(count) * (given[0] + given[1])) - given[2]
        return rhs, trial_of

    def after(c, drive, v, m, memory, unlike):
        applied1, current1, end, *given = drive
        rhs, _ = posed(c, drive)
        trial = trial_of(c, current1, v, m)
        loss, shift, added = extra_terms(effects, c.states, actuator, trial, 0.0, 0.0)
        H, M = v + shift, m + added
        residual = p0 * H + loss + Q @ (H + M) - rhs + unlike
        states = _of_every_shell(tuple(e.advance(trial, s, actuator) for e, s in zip(effects, c.states, strict=True)), count)
        states, marks = _settle(effects, states, c.marks, end, period * h)
        if given:
            H, M = H + given[0], M + given[1]
        mean = weights @ M
        row = (weights @ H, mean, seen * (weights @ (M - mean) ** 2), weights @ v, residual[jnp.argmax(jnp.abs(residual))])
        return _Carry(memory, H + M, c.X0, H, applied1, states, marks), row

    return _Rod(effects, p0, Q, weights, posed, after)


def rested_shells(rod: _Rod, actuator, applied, current, h, memory):
    """The state of a rod at the first sample, and M with what effects add, of every shell."""
    count = memory.field.shape[0]
    zero = jnp.zeros_like(memory.field)
    rest = Trial(memory.field, memory.magnetization, zero, zero, current, h)
    states = _of_every_shell(tuple(e.start(rest, actuator) for e in rod.effects), count)
    _, shift, added = extra_terms(rod.effects, states, actuator, rest, 0.0, 0.0)
    first = memory.field + shift
    X = first + memory.magnetization + added
    return _Carry(memory, X, X, first, applied, states, states), memory.magnetization + added


def again_in_shells(rod: _Rod, actuator, c, drive, branch, corner):
    """A step of all shells on their known branches, as `march._again`: one Newton step with a frozen matrix."""
    rhs, trial_of = rod.posed(c, drive)
    v, along = branch.field, branch.along
    m = corner[1] + branch.base + branch.rise * corner[0]

    def terms(v, m):
        return extra_terms(rod.effects, c.states, actuator, trial_of(c, drive[1], v, m), 0.0, 0.0)

    (loss, shift, added), (d_loss, d_shift, d_added) = jax.jvp(terms, (v, m), (jnp.ones_like(v), along))
    matrix = jnp.diag(rod.p0 * (1 + d_shift) + d_loss) + rod.Q * (1 + d_shift + along + d_added)
    change = -inverse_of_definite(stop_gradient(matrix)) @ (rod.p0 * (v + shift) + loss + rod.Q @ (v + shift + m + added) - rhs)
    v, m = v + change, m + along * change
    return v, m, lambda memory: rod.after(c, drive, v, m, memory, 0.0)


def _of_every_shell(states, count):
    """States of effects, the last axis of each the shells: some do not differ between them."""
    return jax.tree.map(lambda s: jnp.broadcast_to(jnp.asarray(s, float), (*jnp.shape(s)[:-1], count)), states)


def _relays(table, memory, v):
    """Branch and magnetization of every shell at fields v: (M, dM/dv, rising, kept)."""

    def one(memory, v):
        rising, kept, threshold, m_there = memory.branch(table, v)
        return branch_magnetization(table, rising, threshold, m_there, v), slope_of(table, v, threshold, rising), rising, kept

    return jax.vmap(one)(memory, v)


def _solve(table, c, rod, actuator, trial_of, current, rhs):
    """Fields and magnetizations of all shells, with exact derivatives, and their branches."""
    effects, p0, Q, weights = rod[:4]
    fixed = stop_gradient((table, c, effects, actuator, Q, rhs, current))

    def misfit(v):
        table, c, effects, actuator, Q, rhs, current = fixed
        m, slope, *_ = _relays(table, c.memory, v)

        def terms(v, m):
            return extra_terms(effects, c.states, actuator, trial_of(c, current, v, m), 0.0, 0.0)

        (loss, shift, added), (d_loss, d_shift, d_added) = jax.jvp(terms, (v, m), (jnp.ones_like(v), slope))
        F = p0 * (v + shift) + loss + Q @ (v + shift + m + added) - rhs
        rise = 1 + d_shift + slope + d_added  # dX/dv
        return F, jnp.diag(p0 * (1 + d_shift) + d_loss) + Q * rise, rise

    def refine(walk):
        v, step, descent, scale, _, number = walk
        F, J, rise = misfit(v + scale * step)
        along = jnp.sum(weights * F * rise * step)  # of the potential whose gradient F is: above zero the minimum was passed
        good = (along <= OVERSHOOT * descent) | (scale < 1e-6)
        v = jnp.where(good, v + scale * step, v)
        fresh = -inverse_of_definite(J) @ F
        shorter = scale * jnp.clip(jnp.nan_to_num(descent / (descent + along)), *SHORTER)
        step, descent = jnp.where(good, fresh, step), jnp.where(good, -jnp.sum(weights * F * rise * fresh), descent)
        return v, step, descent, jnp.where(good, 1.0, shorter), jnp.where(good, jnp.max(jnp.abs(F)), jnp.inf), number + 1

    reach = 0.5 * fixed[0].step * fixed[0].cells
    start = fixed[1].memory.field

    def unsettled(walk):
        return (walk[4] > CLOSE_ENOUGH * reach) & (walk[5] < MOST_STEPS)

    walk = tied((start, jnp.zeros_like(start), jnp.zeros(()), jnp.ones(()), jnp.full((), jnp.inf), 0), start)
    v = stop_gradient(jax.lax.while_loop(unsettled, refine, walk)[0])
    inverse = stop_gradient(inverse_of_definite(misfit(v)[1]))
    _, slope, rising, kept = stop_gradient(_relays(fixed[0], fixed[1].memory, v))

    def live(memory, rising, kept, v):
        _, _, threshold, m_there = memory.select(table, rising, kept)
        return branch_magnetization(table, rising, threshold, m_there, v)

    m = jax.vmap(live)(c.memory, rising, kept, v)
    loss, shift, added = extra_terms(effects, c.states, actuator, trial_of(c, current, v, m), 0.0, 0.0)
    change = -inverse @ (p0 * (v + shift) + loss + Q @ (v + shift + m + added) - rhs)
    return v + change, m + slope * change, rising, kept
