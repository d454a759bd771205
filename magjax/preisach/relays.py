"""The relay grid itself: a masked L x L array of states, for reference, display and teaching.

"hard": delayed relays (T&B Fig. 2) at the centres of the cells. "kp": relays of finite slope (Krasnosel'skii and
Pokrovskii) whose ramps are one cell wide, s = clip(s, up(H), down(H)): they are identical to L play operators.
Their cost grows as L^2 and their gradients are worse than those of the uniform cells, which is why these are not the default.
"""

import jax
import jax.numpy as jnp

from ..errors import ConfigurationError


def relay_rule(surrogate: str, levels):
    """The update s' = rule(s, H) of the (L, L) state array for thresholds between `levels`."""
    lower, upper = levels[:-1], levels[1:]
    if surrogate == "hard":
        centre = 0.5 * (lower + upper)
        alpha, beta = centre[:, None], centre[None, :]
        return lambda state, field: jnp.where(field > alpha, 1.0, jnp.where(field < beta, -1.0, state))
    if surrogate == "kp":

        def ramps(state, field):
            # one ramp for the rising and one for the falling threshold, each a cell wide
            ramp = 2.0 * jnp.clip((field - lower) / (upper - lower), 0.0, 1.0) - 1.0
            return jnp.minimum(jnp.maximum(state, ramp[:, None]), ramp[None, :])

        return ramps
    raise ConfigurationError(f'surrogate = "{surrogate}" is unknown; write "uniform", "kp" or "hard"')


def relay_states(operator, field, surrogate: str):
    """The states of all relays after each field: (time, L, L) in [-1, 1]."""
    rule = relay_rule(surrogate, operator.levels)
    state = -jnp.ones_like(operator.masses)
    for k in range(operator.history.shape[0]):
        state = rule(state, operator.history[k])

    def advance(state, value):
        state = rule(state, value)
        return state, state

    return jax.lax.scan(advance, state, jnp.asarray(field, dtype=float))[1]


def relay_magnetization(operator, field, surrogate: str):
    """M over time as the masked sum over the relay array, A/m."""
    rule = relay_rule(surrogate, operator.levels)
    masses = jnp.tril(operator.masses)
    state = -jnp.ones_like(masses)
    for k in range(operator.history.shape[0]):
        state = rule(state, operator.history[k])

    def advance(state, value):
        state = rule(state, value)
        return state, operator.offset + jnp.sum(masses * state)

    return jax.lax.scan(advance, state, jnp.asarray(field, dtype=float))[1]
