"""coil: the field takes time to diffuse into the rod, so the outer part switches before the inner one."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect
from .lags import lagged

KNEE = 0.9  # share from which it bends towards 1; beyond 1, or below 0, the matrix of the shells is not positive and no
BELOW = 1e-6  # step has a solution, the sooner the shorter it is (-3e-5 at 500 samples a period): least share
ZEROS = np.array([3.83170597020751, 7.01558666981562, 10.17346813506272, 13.32369193631422, 16.47063005087763, 19.61585851046824])  # of the Bessel function J1
WEIGHTS = 8 / ZEROS**2  # of the modes' losses in that of the cylinder, 0.88 of it; those beyond follow at once
BEGUN = 0.9, 1e-4  # share and time, s, from which a fit of the modes begins


class FieldDiffusion(AbstractEffect):
    """Skin effect of a solid cylinder: depths with their own field and relays in place of one loss k dB/dt for all, four nodes of Gauss and
    Legendre over the section (`chain.shells`).

    Sections stay plane: the rod strains by the mean of M^2 over the section. In detail a share `alike` of the variance of M is not
    seen, as where the rod strains by the square of the mean M: a section that magnetizes as one, as lumped models of the skin effect have it.
    """

    kappa: Float[Array, ""] = param(
        0.0,
        "1",
        "share of the loss that is distributed as in a solid cylinder",
        low=0.0,
        high=1.0,
        scale=0.3,
        null=0.0,
        typical=(0.05, 1.0),
        firm=True,
    )

    alike: Float[Array, ""] = param(
        0.0, "1", "share of the variance of M that the strain does not see", low=0.0, high=1.0, scale=0.5, shape=True, detail=True, typical=(0.0, 1.0)
    )

    name = "field_diffusion"
    block = "coil"
    law = (
        "k mean dB/dt -> k [(1 - kappa) mean dB/dt + kappa int_0^1 -2 ln max(u, u') dB(u')/dt du'] at the depth u = (r/R)^2; "
        "strain by mean m^2, in detail less alike var m; or by the modes of a rod of one permeability, k dB/dt -> k [(1 - kappa) dB/dt + "
        "kappa sum_n (8/j_n^2) lag_n(dB/dt)], lag of (j_1/j_n)^2 tau, J1(j_n) = 0, in detail (j_1/j_n)^(2 - nearer) tau"
    )
    source = "Ampere's and Faraday's laws in a conducting cylinder: J. Lammeraner, M. Stafl, Eddy Currents, 1966"
    signature = (
        "the eddy lag grows more slowly than frequency, and the skin switches ahead of the core: rounded corners at high frequency"
    )
    amplitude = "kappa"
    in_step = True
    shells = 4

    @classmethod
    def finite_trials(cls, drives, fluxes, steps):
        """The mean field and magnetization do not change to first order: scored where the skin leads, in either form of the strain."""
        return [{"kappa": 0.5}, {"kappa": 0.5, "alike": 1.0}]

    @classmethod
    def elsewhere(cls, actuator):
        """The other form of the law: a rod of one permeability."""
        return (DiffusionModes(*BEGUN),)

    def share(self):
        """The share in use: `kappa`, kept between -BELOW and 1."""
        above = KNEE + (1 - KNEE) * jnp.tanh((self.kappa - KNEE) / (1 - KNEE))
        return jnp.where(self.kappa > KNEE, above, jnp.where(self.kappa < 0, BELOW * jnp.tanh(self.kappa / BELOW), self.kappa))


class DiffusionModes(AbstractEffect):
    """The same in a rod of one permeability: its field is that of modes, each with a time of its own, and the loss is late as a whole.

    H less mu^-1 mean B = k s mean B sum_n (8/j_n^2) / (1 + s tau_n), from mean B / H = 2 J1(x) / (x J0(x)) of a cylinder: the total
    is k. The shells let the permeability follow the loop in every depth; lumped models and linear ladders have this form. In detail
    the times are (j_1/j_n)^(2 - nearer) tau: those of a rod that is not the same throughout, or of a ladder.
    """

    kappa: Float[Array, ""] = param(
        0.0, "1", "share of the loss that comes late", low=0.0, high=1.0, scale=0.3, null=0.0, typical=(0.05, 1.0)
    )
    tau: Float[Array, ""] = param(1e-4, "s", "time of the slowest mode", low=0.0, scale=1e-4, shape=True, typical=(1e-6, 1e-3))
    nearer: Float[Array, ""] = param(
        0.0, "1", "by how much nearer to one another the modes' times are", low=-1.0, high=1.5, scale=0.3, shape=True, detail=True, typical=(-0.5, 0.5)
    )

    name = FieldDiffusion.name
    form = "by modes"
    block = FieldDiffusion.block
    law = FieldDiffusion.law
    source = FieldDiffusion.source
    signature = "an eddy lag that grows more slowly than frequency"
    amplitude = "kappa"
    in_step = True

    def _late(self, trial, state):
        """The modes' flux rates after the step."""
        times = (self.tau * (ZEROS[0] / ZEROS) ** (2 - self.nearer)).reshape(-1, *(1,) * (state[0].ndim - 1))
        return lagged(state[0], state[1], trial.flux_rate, trial.h, times)

    def start(self, trial, actuator):
        """The flux is at rest: the modes' rates of it, and its own."""
        zero = jnp.zeros_like(trial.field)
        return (jnp.zeros((len(ZEROS), *zero.shape)), zero)

    def field_shift(self, trial, state, actuator):
        """What the loss lacks, or has too much, A/m."""
        late = jnp.tensordot(WEIGHTS, self._late(trial, state) - trial.flux_rate, 1)
        return self.kappa * actuator.coil.loss * late

    def advance(self, trial, state, actuator):
        """The modes' rates, and the flux's own, after the step."""
        return (self._late(trial, state), trial.flux_rate)


FieldDiffusion.forms = (DiffusionModes,)
