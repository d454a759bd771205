"""Projected Levenberg-Marquardt for bounded, scaled least squares, behind optimistix's interface.

optimistix brings no bounds and one Jacobian a trial; here bounds (a pair of arrays, lower and upper, infinite where there
is none) are kept by block pivoting on the normal equations, the Jacobian is built in chunks of columns by `linearize`, may
come from a coarser grid than the residual (`options["jacobian_fn"]`), and one step is one Jacobian with as many trial
dampings as it needs.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array
from scipy.linalg import cho_factor, cho_solve

CHUNK = 40
CURVED = -2.0, 0.5  # of the promised fall, between which a step is led back into the valley; what rises by more, that seldom saves
LOADS = tuple(10.0**-k for k in range(2, 10))  # on a diagonal of ones


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
    """Levenberg-Marquardt on a flat vector between `bounds`, (lower, upper).

    Stops when the predicted fall of half chi2 (the Newton decrement) is below `atol` + `rtol` * cost.
    """

    bounds: Any
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
            new, predicted = traced_step(normal, gradient, y, damping, self.bounds)
            new_cost = 0.5 * jnp.sum(fn(new, args)[0] ** 2)
            ratio = (cost - new_cost) / jnp.maximum(predicted, 1e-300)
            good = (ratio > 1e-3) & jnp.isfinite(new_cost)
            following = jnp.where(ratio > 0.5, damping * 0.15, jnp.where(good, damping, damping * 6.0))
            return following, jnp.where(good, new, y), jnp.where(good, new_cost, cost), good, tried + 1

        start = (state.damping, y, cost, jnp.asarray(False), jnp.asarray(0))
        damping, new, new_cost, good, _ = jax.lax.while_loop(lambda c: ~c[3] & (c[4] < self.trials), attempt, start)
        fallen = cost - new_cost
        # what fell was there to fall, also where the pivoting without damping does not end
        decrement = jnp.maximum(traced_step(normal, gradient, y, 1e-9, self.bounds)[1], fallen)
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


class SteppedState(eqx.Module):
    """What a step from Python carries: damping, cost (half of chi2 and of what the prior adds), the data's residual, J'J
    and the gradient of the cost (J of where the step began), the fall that is still promised, the fall of the last step, and whether one was taken."""

    damping: float
    cost: float
    residual: np.ndarray
    information: np.ndarray
    gradient: np.ndarray
    decrement: float
    gained: float
    good: bool

    @property
    def chi2(self) -> float:
        """Of the data alone."""
        return float(self.residual @ self.residual)


class SteppedLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """The same method for a caller that takes its steps one by one, in NumPy: `fn` and `options["jacobian"]`, a function of
    the unknowns, are compiled programs, and there is nothing else to compile.

    `options["prior"]`: the curvature of a quadratic prior, which adds y'Py / 2 to half the sum of squares. A step whose fall
    is far from what it promised is led back into the valley. For `optimistix.least_squares`, which traces the step, take
    `ProjectedLevenbergMarquardt`.
    """

    bounds: Any
    rtol: float = 1e-4
    atol: float = 0.5
    norm: Any = optx.max_norm
    trials: int = 8

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        residual, prior = fn(y, args)[0], options["prior"]
        return SteppedState(1e-2, cost_of(residual, y, prior), residual, np.zeros_like(prior), np.zeros_like(y), np.inf, 0.0, False)

    def step(self, fn, y, args, options, state, tags):
        prior, residual, cost, damping = options["prior"], state.residual, state.cost, state.damping
        J = options["jacobian"](y)
        with np.errstate(over="ignore", invalid="ignore"):
            information, gradient = J.T @ J, J.T @ residual + prior @ y
        if not (np.isfinite(information).all() and np.isfinite(gradient).all()):  # from a start beyond all reason no step leads back
            none = np.zeros_like(prior), np.zeros_like(y)
            return y, SteppedState(damping, cost, residual, *none, np.inf, 0.0, False), None
        normal, good, new = information + prior, False, None
        for _ in range(self.trials):
            new, predicted = damped_step(normal, gradient, y, damping, self.bounds, new)
            trial = fn(new, args)[0]
            new_cost = cost_of(trial, new, prior)
            ratio = (cost - new_cost) / float(predicted) if float(predicted) > 1e-12 * cost else -1.0
            reached = new
            if CURVED[0] < ratio < CURVED[1] and float(predicted) > 1e-4 * cost + 1:
                curved = J.T @ trial + prior @ new - gradient - normal @ (new - y)
                back = led_back(normal, curved, new, damping, self.bounds)
                other = fn(back, args)[0]
                other_cost = cost_of(other, back, prior)
                if not other_cost >= new_cost:
                    reached, trial, new_cost, ratio = back, other, other_cost, (cost - other_cost) / float(predicted)
            good = bool(np.isfinite(new_cost) and ratio > 1e-3)
            damping = max(damping * (0.15 if ratio > 0.5 else 1.0 if good else 6.0), 1e-9)
            if good or float(predicted) < 1e-6 * cost + 1e-3:
                break
        decrement = float(damped_step(normal, gradient, y, 1e-9, self.bounds, new)[1])
        if not good:
            return y, SteppedState(damping, cost, residual, information, gradient, decrement, 0.0, False), None
        left = J.T @ trial + prior @ reached
        return reached, SteppedState(damping, new_cost, trial, information, left, decrement, cost - new_cost, True), None

    def terminate(self, fn, y, args, options, state, tags):
        return state.decrement < self.atol + self.rtol * state.cost, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {"decrement": state.decrement, "normal": state.information + options["prior"]}


def cost_of(residual, y, prior) -> float:
    """Half of chi2 and of what a quadratic prior adds; infinite where a step has left all reason."""
    with np.errstate(over="ignore", invalid="ignore"):
        return 0.5 * float(residual @ residual + y @ prior @ y)


def led_back(normal, curved, new, damping, bounds):
    """From the end `new` of a step back towards the valley that it left (geodesic acceleration; Transtrum, Sethna 2012). `curved`:
    the gradient there less what it would be along straight lines, by the Jacobian of where the step began: to second order that
    needs no further march. What the step has put at a bound stays there."""
    lower, upper = bounds
    free = np.flatnonzero((new > lower) & (new < upper))
    scale = 1 / np.sqrt(np.maximum(np.diag(normal)[free], 1e-300))
    matrix = normal[np.ix_(free, free)] * scale[:, None] * scale + damping * np.eye(len(free))
    back = new.copy()
    back[free] -= scale * np.linalg.solve(matrix + 1e-12 * np.eye(len(free)), scale * curved[free])
    return np.clip(back, lower, upper)


def damped_step(normal, gradient, y, damping, bounds, near=None):
    """The bounded step under a damping relative to the diagonal: (new point, predicted fall of half chi2). In NumPy: nothing to compile.
    `near`: that under another damping."""
    scale = np.diagonal(normal)
    scale = scale + 1e-12 * np.max(scale)
    new = bounded_minimum(normal + np.diag(damping * scale), gradient, y, bounds, near)
    delta = new - y
    return new, -(gradient @ delta + 0.5 * delta @ normal @ delta)


def traced_step(normal, gradient, y, damping, bounds, rounds: int = 25):
    """`damped_step` within a compiled program, by block pivoting alone; where that has not ended (a nearly singular
    matrix) the fall may be none, and more damping is asked for. No call back to NumPy: those may wait for one another forever."""
    scale = jnp.diagonal(normal)
    scale = scale + 1e-12 * jnp.max(scale)
    root = jnp.sqrt(jnp.maximum((1 + damping) * scale, 1e-300))
    A = (normal + jnp.diag(damping * scale)) / jnp.outer(root, root)
    g, floor, ceiling = gradient / root, (bounds[0] - y) * root, (bounds[1] - y) * root

    def pivot(carry):
        side, _, best, count, k = carry  # -1 at the floor, 1 at the ceiling, 0 free
        free = side == 0
        held = jnp.where(free, 0.0, jnp.where(side < 0, floor, ceiling))
        factor = jax.scipy.linalg.cho_factor(
            jnp.where(jnp.outer(free, free), A, 0.0) + jnp.diag(jnp.where(free, 1e-13, 1.0)), lower=True
        )
        d = held + jax.scipy.linalg.cho_solve(factor, jnp.where(free, -(g + A @ held), 0.0))
        past = (d > ceiling + 1e-12) * 1 - (d < floor - 1e-12) * 1
        proper = jnp.where(free, past, jnp.where(side * (g + A @ d) > 1e-12, 0, side))
        bad = proper != side
        number = jnp.sum(bad)
        last = jnp.arange(len(g)) == jnp.max(jnp.where(bad, jnp.arange(len(g)), -1))
        single = (number >= best) & (count >= 3)  # Murty's exchange once the blocks' makes no progress
        count = jnp.where(number < best, 0, count + 1)
        return jnp.where(single & ~last, side, proper), d, jnp.minimum(best, number), count, k + 1

    side = ((ceiling <= 0) & (g < 0)) * 1 - ((floor >= 0) & (g > 0)) * 1
    start = side, jnp.zeros_like(g), jnp.asarray(len(g) + 1), jnp.asarray(0), jnp.asarray(0)
    side, d, *_ = jax.lax.while_loop(lambda c: (c[2] > 0) & (c[4] < rounds), pivot, start)
    new = jnp.where(d <= floor, bounds[0], jnp.where(d >= ceiling, bounds[1], y + d / root))
    delta = new - y
    return new, -(gradient @ delta + 0.5 * delta @ normal @ delta)


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


def bounded_minimum(A, gradient, y, bounds, near=None) -> np.ndarray:
    """The point between `bounds` where gradient'd + d'A d/2 is least, d counted from y; what ends at a bound is there exactly.
    `near`: a point that is expected to end at most of the same bounds.

    Block principal pivoting on the free set, quick but without a promise; where it has not ended (a nearly singular A), anew under
    a load on the diagonal that is let go by decades, each from the bounds of the one before; and where that has not either, a
    feasible active set, which falls at every step.
    """
    scale = 1 / np.sqrt(np.maximum(np.diagonal(A), 1e-300))
    A = A * scale[:, None] * scale[None, :]
    g = gradient * scale
    walls = tuple(np.clip((bound - y) / scale, -1e300, 1e300) for bound in bounds)
    near = y if near is None or not np.isfinite(near).all() else near
    side = first = (near >= bounds[1]) * 1 - (near <= bounds[0]) * 1
    d, side, ended = _pivoted(A, g, walls, side)
    if not ended:
        side = first
        for load in (*LOADS, 0.0):
            d, side, ended = _pivoted(A + load * np.eye(len(A)), g, walls, side)
    if not ended:
        d = _descended(A, g, walls, d)
    return np.where(d <= walls[0], bounds[0], np.where(d >= walls[1], bounds[1], np.clip(y + d * scale, *bounds)))


def _minimum(A, g, fixed, at):
    """The minimum over the free unknowns, the `fixed` ones held where `at` says."""
    free = np.flatnonzero(~fixed)
    found = np.where(fixed, at, 0.0)
    if not len(free):
        return found
    inner = A[np.ix_(free, free)]
    inner.flat[:: len(free) + 1] += 1e-13
    try:
        found[free] = -cho_solve(cho_factor(inner, lower=True, check_finite=False), (g + A @ found)[free], check_finite=False)
    except np.linalg.LinAlgError:  # NaN, or not positive: no step, and the caller sees that it did not end well
        found[free] = np.nan
    return found


def _pivoted(A, g, walls, side, rounds: int = 10):
    """Block principal pivoting between the walls, (lowest, highest) step, from which unknowns are at which (-1, 1; 0 free):
    (step, the same of it, whether it is the optimum)."""
    floor, ceiling = walls
    best, count, number = len(g) + 1, 0, 0
    for _ in range(rounds):
        d = _minimum(A, g, side != 0, np.where(side < 0, floor, ceiling))
        inward = side * (g + A @ d) > 1e-12
        proper = np.where(side != 0, np.where(inward, 0, side), (d > ceiling + 1e-12) * 1 - (d < floor - 1e-12) * 1)
        bad = np.flatnonzero(proper != side)
        number = len(bad)
        if not number:
            break
        if number >= best and count >= 3:
            # Murty's single exchange once the block exchange stops making progress
            side = side.copy()
            side[bad[-1]] = proper[bad[-1]]
        else:
            side = proper
        best, count = min(best, number), 0 if number < best else count + 1
    return np.clip(d, floor, ceiling), side, not number


def _descended(A, g, walls, d, most: int = 400):
    """The feasible active set from `d`, or from 0 where that is lower: unknowns that a step drives past a wall are fixed
    there (all of them where that falls further than to the first of them), and freed again at the minimum of the rest."""
    floor, ceiling = walls
    tolerance = 1e-11 * np.max(np.abs(g))

    def height(x):
        return g @ x + 0.5 * x @ A @ x

    def outward(x, slope):
        return ((x <= floor) & (slope > 0)) | ((x >= ceiling) & (slope < 0))

    if not height(d) < 0:
        d = np.zeros_like(d)
    fixed, low = outward(d, g + A @ d), np.inf
    for _ in range(most):
        x = _minimum(A, g, fixed, d)
        past = ~fixed & ((x < floor) | (x > ceiling))
        if past.any():
            wall = np.where(x < floor, floor, ceiling)
            reach = np.where(past, (wall - d) / np.where(past, x - d, 1.0), np.inf)
            part = np.clip(np.min(reach), 0.0, 1.0)
            first = past & (reach <= part)
            whole, partly = np.clip(x, floor, ceiling), np.where(first, wall, np.clip(d + part * (x - d), floor, ceiling))
            farther = height(whole) < height(partly)
            d, fixed = (whole, fixed | past) if farther else (partly, fixed | first)
            continue
        # at a minimum of the free: let go of those that pull inward, of one alone where nothing was gained since the last
        d, slope = x, g + A @ x
        pull = np.where(fixed & ~outward(x, slope), np.abs(slope), 0.0)
        pulled = pull > tolerance
        if not pulled.any():
            break
        gained = np.isfinite(low) and height(x) < low - 1e-13 * np.abs(low)
        fixed, low = fixed & ~(pulled & (gained | (pull >= np.max(pull)))), height(x)
    return d
