"""mechanics: dry friction in guides and seals, with the presliding of its bristles."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect

STEEPEST = 50.0  # f over presliding, both m: a rod springs back by 2 f at a turn, so that a shorter way hardly shows
NEWTON = 8  # steps to the displacement that a sample's friction allows; from the side where they only approach
VISCOUS = 0.1  # m/s, below which friction that is still viscous is none: a damper
NEVER_PAST = 2e-5  # m of presliding, within which the rod hardly leaves it: a spring with losses
PASSES = 7  # over a period; each begins with the steady response to the friction of the one before
FURTHER = 4  # doublings of what they are carried on by
FINEST = 2000  # samples a period at least: after each turn the rod swings at its own frequency, far above a slow drive's


def _turned(moved, p, law):
    """The friction's share after a sample's motion, m; `law`: (stribeck, its way, viscous way, presliding way)."""
    stribeck, fast, slow, way = law
    top = 1 + stribeck * jnp.exp(-((moved / fast) ** 2))
    keep = jnp.exp(-(jnp.abs(moved) + slow) / (way * top))
    return top * jnp.tanh(moved / slow) * (1 - keep) + p * keep


def _balance(moved, free, p, reach, law):
    """moved + reach turned(moved, p) - free, and its slope."""
    p_there, slope = jax.jvp(lambda m: _turned(m, p, law), (moved,), (jnp.ones_like(moved),))
    return moved + reach * p_there - free, 1 + reach * slope


@jax.jit  # traced once, though a sample asks for it many times
def _closer(moved, low, high, free, p, reach, law):
    """One safeguarded Newton step towards its zero: (moved, low, high)."""
    left, slope = _balance(moved, free, p, reach, law)
    low, high = jnp.where(left < 0, moved, low), jnp.where(left < 0, high, moved)
    step = moved - left / slope
    return jnp.where((step >= low) & (step <= high), step, 0.5 * (low + high)), low, high


def _share(free, p, reach, law, moved):
    """The friction's share after a sample, differentiable, where the motion `moved` that it allows is known."""
    left, slope = _balance(moved, free, p, reach, law)
    return _turned(moved - left / jax.lax.stop_gradient(slope), p, law)


def _settled(passed, steady, law, reach, f, mechanics, held, displacement):
    """The friction's own motion over a period after `PASSES` and, to first order, 2 ** FURTHER more; and its derivative.

    A derivative goes through the last pass alone, step by step with known slopes by free motion and share. What it and the last
    pass make of the period's begin is carried on by powers of the three by three matrix of a pass.
    """

    def again(_, begin):
        return steady(passed(begin)[3], f, mechanics)[1]

    begin = jax.lax.stop_gradient(jax.lax.fori_loop(0, PASSES - 1, again, jnp.zeros(3, displacement.dtype)))
    free, before, moved, *_ = jax.lax.stop_gradient(passed(begin))
    fixed = jax.lax.stop_gradient((reach, law))
    by_free, by_share = (
        jax.jvp(lambda x, y: _share(x, y, *fixed, moved), (free, before), along)[1]
        for along in ((jnp.ones_like(free), jnp.zeros_like(free)), (jnp.zeros_like(free), jnp.ones_like(free)))
    )

    def replay(begin, displacement, reach, law, f, mechanics, held):
        ((a, b), (c, d)), first, last = held[0], -f * (held[1] - held[2]), -f * held[2]

        def step(carry, here):  # number by number: a product of matrices stands in the way of the compiler
            x, y, p = carry  # own motion and its rate, share
            share, by_free, by_share = here
            rest, y = a * x + b * y + first[0] * p, c * x + d * y + first[1] * p
            now = share + by_free * (rest - x) + by_share * p
            return (rest + last[0] * now, y + last[1] * now, now), now

        linear = jnp.concatenate([displacement[-1:], displacement])
        share = _share(free, before, reach, law, moved) + by_free * (jnp.diff(linear) - free) - by_share * before
        late = jax.lax.scan(step, tuple(begin), (share, by_free, by_share))[1]
        return steady(late, f, mechanics)

    live = displacement, reach, law, f, mechanics, held
    _, push = jax.linearize(lambda x: replay(x, *jax.lax.stop_gradient(live)), begin)
    by_begin, matrix = jax.vmap(push)(jnp.eye(3, dtype=begin.dtype))  # (3, time), (3, 3): row by row what each number changes
    further = jnp.eye(3, dtype=begin.dtype)  # the sum of the powers of a pass
    for _ in range(FURTHER):
        further, matrix = further + further @ matrix, matrix @ matrix
    own, end = replay(begin, *live)
    return own + (end - begin) @ further @ by_begin


class CoulombFriction(AbstractEffect):
    """Friction as an equivalent displacement F/k: Dahl's law, viscous below a velocity, and LuGre's rise towards rest.

    Solved sample by sample. It may exceed what the rod's stiffness moves within the presliding, so that the rod sticks at
    its turns. The way of presliding is taken as f/50 at least.
    """

    f: Float[Array, ""] = param(0.0, "m", "friction force over stiffness", low=0.0, scale=1e-7, null=0.0, typical=(1e-8, 5e-6))
    v_s: Float[Array, ""] = param(
        3e-5, "m/s", "velocity below which friction is viscous", low=0.0, scale=3e-4, shape=True, typical=(1e-6, 3e-2)
    )
    presliding: Float[Array, ""] = param(
        3e-8, "m", "way over which friction turns with the motion", low=0.0, scale=1e-7, shape=True, typical=(1e-9, 1e-5)
    )
    stribeck: Float[Array, ""] = param(
        0.0,
        "1",
        "by how much more friction there is near rest (Stribeck)",
        low=0.0,
        scale=0.1,
        shape=True,
        detail=True,
        typical=(0.0, 1.0),
    )
    v_stribeck: Float[Array, ""] = param(
        1e-3, "m/s", "velocity over which that falls", low=1e-6, scale=1e-3, shape=True, detail=True, typical=(1e-4, 1e-1)
    )

    name = "coulomb_friction"
    block = "mechanics"
    law = (
        "force -k f p, dp/dt = (|y'| + v_s)(tanh(y'/v_s) - p/S)/presliding, S = 1 + stribeck exp(-(y'/v_stribeck)^2); LuGre's law as "
        "v_s -> 0, Dahl's without stribeck, Coulomb's as presliding -> 0 too"
    )
    source = "P. R. Dahl (1968); C. Canudas de Wit et al., IEEE Trans. Autom. Control 40 (1995) 419, and references there"
    signature = "a step at each turning point, of the same size at every amplitude and frequency"
    amplitude = "f"

    def is_itself(self) -> bool:
        """Not where it is viscous at every velocity, or never past its presliding."""
        return bool((self.v_s < VISCOUS) & (self.presliding < NEVER_PAST))

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement with friction, m; of a steady period on a grid of `FINEST` samples or more."""
        if not line.periodic:
            return self._with_friction(displacement, line, actuator)
        times = -(-FINEST // line.count)
        spectrum = jnp.fft.rfft(displacement)
        if line.count % 2 == 0:  # what stands at the highest line is both of its sides
            spectrum = spectrum.at[-1].multiply(0.5)
        finer = dataclasses.replace(line, dt=line.dt / times, count=times * line.count)
        between = times * jnp.fft.irfft(spectrum, finer.count)
        return displacement + (self._with_friction(between, finer, actuator) - between)[::times]

    def _with_friction(self, displacement, line, actuator):
        way = jnp.maximum(jnp.maximum(self.presliding, self.f / STEEPEST), 1e-10)
        slow = jnp.maximum(self.v_s, 1e-9) * line.dt  # m a sample
        mechanics = actuator.mechanics
        A, gain, rise = mechanics.held(line.dt)
        # steps too coarse for the resonance hold the friction of their end: linear in between, a rod that sticks would swing up
        coarse = (jnp.pi * mechanics.f0 * line.dt) ** 2
        rise = rise + coarse / (1 + coarse) * (gain - rise)
        reach = self.f * rise[0]  # what full friction takes back within the sample

        law = (self.stribeck, line.dt * self.v_stribeck, slow, way)

        def allowed(*given):
            """`moved` where that is zero; from the near end of where it can be Newton only approaches, but for Stribeck's."""
            free, p, reach, law = jax.lax.stop_gradient(given)
            most = reach * (1 + law[0])
            at_rest = reach * _turned(0.0, p, law)
            ahead = free > at_rest
            low = jnp.where(ahead, jnp.maximum(free - most, 0.0), free - at_rest)
            high = jnp.where(ahead, free - at_rest, jnp.minimum(free + most, 0.0))
            near = jnp.where(ahead, low, high)
            moved = jnp.where(near == 0, jnp.where(ahead, 1.0, -1.0) * 1e-300, near)
            for _ in range(NEWTON):
                moved, low, high = _closer(moved, low, high, free, p, reach, law)
            return moved

        def step(carry, linear):
            state, p, before = carry  # of the friction's own motion; turned share; displacement with friction
            rest = A @ state - (gain - rise) * self.f * p
            free = linear + rest[0] - before
            moved = allowed(free, p, reach, law)
            now = _share(free, p, reach, law, moved)
            state = rest - rise * self.f * now
            return (state, now, linear + state[0]), (free, p, moved, now, state[0])

        state, p = jnp.zeros(2, displacement.dtype), jnp.zeros_like(displacement[0])
        if not line.periodic:
            _, (*_, own) = jax.lax.scan(step, (state, p, displacement[0]), displacement)
            return displacement + own

        def steady(late, f, mechanics):
            """Motion by a period's turned shares, and where the next period begins: (own motion, its rate, share)."""
            own = line.filter(-f * late, mechanics.response)
            rate = line.filter(-f * late, lambda s: mechanics.response(s) * s / (2 * jnp.pi * mechanics.f0))
            return own, jnp.stack([own[-1], rate[-1], late[-1]])

        def passed(begin):
            return jax.lax.scan(step, (begin[:2], begin[2], displacement[-1] + begin[0]), displacement)[1]

        return displacement + _settled(passed, steady, law, reach, self.f, mechanics, (A, gain, rise), displacement)
