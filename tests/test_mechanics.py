"""The exact step of the mechanics: the matrix exponential behind it, at any step, batched and differentiated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from magjax.chain import Mechanics, Timeline
from magjax.effects.forces import with_force
from tests.test_simulate import actuator


@pytest.mark.parametrize("f0, xi, dt", [(392.0, 0.78, 1e-6), (392.0, 0.01, 1e-4), (392.0, 3.0, 0.1), (2e4, 0.02, 10.0)])
def test_the_step_is_the_matrix_exponential(f0, xi, dt):
    """From a thousandth of a period to more periods than a scaling by 2^16 reaches."""
    w0 = 2 * np.pi * f0
    rows = np.array([[0, w0, 0, 0], [-w0, -2 * xi * w0, w0, 0], [0, 0, 0, 1 / dt], [0, 0, 0, 0]])
    want = expm(dt * rows)
    A, gain, rise = jax.jit(lambda m: m.held(dt))(Mechanics(f0=f0, xi=xi))
    for got, part in zip((A, gain, rise), (want[:2, :2], want[:2, 2], want[:2, 3]), strict=True):
        assert np.abs(got - part).max() < 1e-13


def test_batches_of_steps_ask_nothing_of_lapack_and_have_derivatives():
    f0, dt = jnp.linspace(100.0, 1e4, 50), 1e-4
    step = jax.jit(jax.vmap(lambda f: jax.jvp(lambda x: Mechanics(f0=x, xi=0.3).held(dt)[2], (f,), (1.0,))))
    assert "lapack" not in step.lower(f0).as_text()
    rise, slope = step(f0)
    change = 1e-4 * f0
    number = (step(f0 + change)[0] - step(f0 - change)[0]) / (2 * change[:, None])
    assert np.abs(slope - number).max() < 1e-6 * np.abs(slope).max()
    gradient = jax.grad(lambda x: Mechanics(f0=x, xi=0.3).held(dt)[2][0])(f0[20])
    assert float(gradient) == pytest.approx(float(slope[20, 0]), rel=1e-12)


@pytest.mark.parametrize(("stiffness", "frequency"), [(0.3, 10.0), (3.0, 10.0), (3.0, 300.0), (9.0, 10.0)])
def test_a_stop_stiffer_than_the_rod_is_solved_at_any_frequency(stiffness, frequency):
    """Beyond the harmonics that are coupled a fixed point under no force swings up by the stiffness, at low frequencies: mm were left of 0.05 mm."""
    act, stop, samples = actuator(20), 33e-6, 125
    line = Timeline(jnp.asarray(1 / (frequency * samples)), samples, True)
    free = 27e-6 * (1 - jnp.cos(2 * jnp.pi * jnp.arange(samples) / samples))
    linear = line.filter(free, act.mechanics.response)

    def force(y, given, series):
        return -stiffness * jnp.maximum(y - stop, 0.0)

    solve = jax.jit(lambda at: with_force(at, force, None, (), line, act))
    y = solve(linear)
    left = y - linear - line.filter(force(y, None, None), act.mechanics.response)
    assert y.max() > stop + 1e-6 and jnp.abs(left).max() < 2e-7 * (stiffness > 3) + 1e-10
    if stiffness < 1:
        slope = jax.jit(lambda at: jax.jvp(solve, (at,), (jnp.cos(linear / 1e-5),))[1])(linear)
        number = (solve(linear + 1e-10 * jnp.cos(linear / 1e-5)) - solve(linear - 1e-10 * jnp.cos(linear / 1e-5))) / 2e-10
        assert jnp.abs(slope - number).max() < 2e-3 * jnp.abs(number).max()
