"""Projected Levenberg-Marquardt for bounded, scaled least squares, behind optimistix's interface.

optimistix brings no bounds and one Jacobian a trial; here the nonnegative unknowns are kept by block pivoting on the
normal equations, the Jacobian is built in chunks of columns by `linearize`, may come from a coarser grid than the
residual (`options["jacobian_fn"]`), and one step is one Jacobian with as many trial dampings as it needs.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

CHUNK = 40


class ProjectedState(eqx.Module):
    """What a step carries: damping, cost (half the sum of squares), the normal matrix and gradient of the last step."""

    damping: Array
    cost: Array
    decrement: Array
    normal: Array
    gradient: Array
    steps: Array
    done: Array
    stalled: Array


class ProjectedLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt on a flat vector with `y[i] >= 0` where `nonnegative[i]`.

    Stops when the predicted fall of half chi2 (the Newton decrement) is below `atol` + `rtol` * cost.
    """

    nonnegative: Any
    rtol: float = 1e-5
    atol: float = 1e-2
    norm: Any = optx.max_norm
    trials: int = 8

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        n = y.shape[0]
        zero = jnp.asarray(0.0)
        return ProjectedState(
            damping=jnp.asarray(options.get("damping", 1e-2)), cost=jnp.asarray(jnp.inf), decrement=jnp.asarray(jnp.inf),
            normal=jnp.zeros((n, n)), gradient=jnp.zeros(n), steps=jnp.asarray(0), done=jnp.asarray(False), stalled=zero > 1,
        )  # fmt: skip

    def step(self, fn, y, args, options, state, tags):
        jacobian_fn = options.get("jacobian_fn", fn)
        residual, aux = fn(y, args)
        cost = 0.5 * jnp.sum(residual**2)
        normal, gradient = normal_equations(lambda z: jacobian_fn(z, args)[0], y, residual)

        def attempt(carry):
            damping, _, _, _, tried = carry
            new, predicted = damped_step(normal, gradient, y, damping, self.nonnegative)
            new_cost = 0.5 * jnp.sum(fn(new, args)[0] ** 2)
            ratio = (cost - new_cost) / jnp.maximum(predicted, 1e-300)
            good = (ratio > 1e-3) & jnp.isfinite(new_cost)
            following = jnp.where(ratio > 0.5, damping * 0.15, jnp.where(good, damping, damping * 6.0))
            return following, jnp.where(good, new, y), jnp.where(good, new_cost, cost), good, tried + 1

        start = (state.damping, y, cost, jnp.asarray(False), jnp.asarray(0))
        damping, new, new_cost, good, _ = jax.lax.while_loop(lambda c: ~c[3] & (c[4] < self.trials), attempt, start)
        _, decrement = damped_step(normal, gradient, y, 1e-9, self.nonnegative)
        fallen = cost - new_cost
        tolerance = self.atol + self.rtol * new_cost
        done = (decrement < tolerance) | ~good
        state = ProjectedState(
            jnp.maximum(damping, 1e-9), new_cost, decrement, normal, gradient, state.steps + 1, done,
            ~good & (decrement > 10 * tolerance) & (fallen <= 0),
        )  # fmt: skip
        return new, state, aux

    def terminate(self, fn, y, args, options, state, tags):
        result = optx.RESULTS.where(state.stalled, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful)
        return state.done, result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {"decrement": state.decrement, "normal": state.normal}


@jax.jit
def damped_step(normal, gradient, y, damping, nonnegative):
    """The bounded step under a damping relative to the diagonal: (new point, predicted fall of half chi2)."""
    scale = jnp.diagonal(normal)
    scale = scale + 1e-12 * jnp.max(scale)
    delta = bounded_step(normal + jnp.diag(damping * scale), gradient, y, nonnegative)
    new = jnp.where(nonnegative, jnp.maximum(y + delta, 0.0), y + delta)
    delta = new - y
    return new, -(gradient @ delta + 0.5 * delta @ normal @ delta)


def padded_step(size: int):
    """`bounded_step` for systems of up to `size` unknowns through the program that the fit's own steps of that size run."""

    def step(A, gradient, y, nonnegative):
        n = len(gradient)
        whole = np.eye(size)
        whole[:n, :n] = A
        gradient, y, nonnegative = (np.concatenate([x, np.zeros(size - n, x.dtype)]) for x in (gradient, y, nonnegative))
        return (np.asarray(damped_step(whole, gradient, y, 0.0, jnp.asarray(nonnegative))[0]) - y)[:n]

    return step


def jacobian(fn, y):
    """The dense Jacobian of fn at y, (residuals, unknowns), in chunks of columns."""
    return pushed(jax.linearize(fn, y)[1], jnp.eye(y.shape[0])).T


def pushed(push, directions, chunk: int = CHUNK):
    """A linear function of each of the directions (a tree of (columns, ...)), in chunks of columns: (columns, ...)."""
    n = jax.tree.leaves(directions)[0].shape[0]
    chunks = -(-n // chunk)
    chunk = -(-n // chunks)  # all of one size: a smaller rest would be compiled once more
    rest = chunks * chunk - n
    parts = jax.tree.map(
        lambda d: jnp.concatenate([d, jnp.zeros((rest, *d.shape[1:]))]).reshape(chunks, chunk, *d.shape[1:]), directions
    )
    rows = jax.lax.map(jax.vmap(push), parts)
    return jax.tree.map(lambda r: r.reshape(chunks * chunk, *r.shape[2:])[:n], rows)


def normal_equations(fn, y, residual):
    """J'J and J'r, the Jacobian taken of `fn` and the residual given."""
    J = jacobian(fn, y)
    return J.T @ J, J.T @ residual


def bounded_step(A, gradient, y, nonnegative, rounds: int = 25):
    """argmin of gradient'd + d'A d/2 with y + d >= 0 where asked.

    Block principal pivoting on the free set, quick but without a promise; where it has not ended after `rounds`
    (a nearly singular A) a feasible active set, which falls at every step, goes on to the optimum.
    """
    scale = 1 / jnp.sqrt(jnp.maximum(jnp.diagonal(A), 1e-300))
    A = A * scale[:, None] * scale[None, :]
    g = gradient * scale
    floor = jnp.where(nonnegative, -y, -jnp.inf) / scale
    d, ended = _pivoted(A, g, floor, nonnegative & (y <= 0) & (gradient > 0), rounds)
    return _descended(A, g, floor, d, ended) * scale


def _minimum(A, g, fixed, at):
    """The minimum over the free unknowns, the `fixed` ones held where `at` says."""
    n = len(g)
    held = jnp.where(fixed, at, 0.0)
    free = ~fixed
    masked = jnp.where(free[:, None] & free[None, :], A, jnp.eye(n))
    factor = jax.scipy.linalg.cho_factor(masked + 1e-13 * jnp.eye(n), lower=True)
    return jnp.where(free, jax.scipy.linalg.cho_solve(factor, jnp.where(free, -(g + A @ held), 0.0)), held)


def _pivoted(A, g, floor, fixed, rounds):
    """Block principal pivoting: (step, whether it is the optimum)."""
    n = len(g)
    floor = jnp.where(jnp.isfinite(floor), floor, -1e300)

    def pivot(carry):
        fixed, _, best, count, k = carry
        d = _minimum(A, g, fixed, floor)
        bad = (~fixed & (d < floor - 1e-12)) | (fixed & (g + A @ d < -1e-12))
        number = jnp.sum(bad)
        # Murty's single exchange once the block exchange stops making progress
        worst = jnp.arange(n) == (n - 1 - jnp.argmax(bad[::-1]))
        stuck = (number >= best) & (count >= 3)
        change = jnp.where(stuck, bad & worst, bad)
        return fixed ^ change, d, jnp.minimum(best, number), jnp.where(number < best, 0, count + 1), k + 1

    start = (fixed, jnp.zeros(n), jnp.asarray(n + 1), jnp.asarray(0), jnp.asarray(0))
    _, d, left, *_ = jax.lax.while_loop(lambda c: (c[2] > 0) & (c[4] < rounds), pivot, start)
    return jnp.maximum(d, floor), left == 0


def _descended(A, g, floor, d, ended, most: int = 400):
    """The feasible active set from `d`, or from 0 where that is lower: unknowns that a step drives below their floor are fixed
    there (all of them where that falls further than to the first of them), and freed again at the minimum of the rest."""
    tolerance = 1e-11 * jnp.max(jnp.abs(g))

    def height(x):
        return g @ x + 0.5 * x @ A @ x

    def onward(carry):
        d, fixed, low, _, k = carry
        x = _minimum(A, g, fixed, d)
        below = ~fixed & (x < floor)
        reach = jnp.where(below, (floor - d) / jnp.where(below, x - d, -1.0), jnp.inf)
        part = jnp.clip(jnp.min(reach), 0.0, 1.0)
        first = below & (reach <= part)
        whole, partly = jnp.maximum(x, floor), jnp.where(first, floor, jnp.maximum(d + part * (x - d), floor))
        farther = height(whole) < height(partly)
        blocked = jnp.any(below)
        # at a minimum of the free: let go of those that pull inward, of one alone where nothing was gained since the last
        slope = g + A @ x
        pull = fixed & (slope < -tolerance)
        gained = height(x) < low - 1e-13 * jnp.abs(low)
        released = pull & (gained | (slope <= jnp.min(jnp.where(pull, slope, jnp.inf))))
        d = jnp.where(blocked, jnp.where(farther, whole, partly), x)
        fixed = jnp.where(blocked, fixed | jnp.where(farther, below, first), fixed & ~released)
        return d, fixed, jnp.where(blocked, low, height(x)), ~blocked & ~jnp.any(pull), k + 1

    start = jnp.where(ended | (height(d) < 0), d, 0.0)
    fixed = (start <= floor) & (g + A @ start > 0)
    d, *_ = jax.lax.while_loop(lambda c: ~c[3] & (c[4] < most), onward, (start, fixed, jnp.asarray(jnp.inf), ended, jnp.asarray(0)))
    return d
