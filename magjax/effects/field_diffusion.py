"""coil: the field takes time to diffuse into the rod, so the outer part switches before the inner one."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..param import param
from .base import AbstractEffect

KNEE = 0.9  # share from which it bends towards 1; beyond 1, or far below 0, the matrix of the shells is not positive and no
BELOW = 0.02  # step has a solution: least share


class FieldDiffusion(AbstractEffect):
    """Skin effect of a solid cylinder: shells with their own field and relays in place of one loss k dB/dt for all (`chain.shells`).

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
    )

    alike: Float[Array, ""] = param(
        0.0, "1", "share of the variance of M that the strain does not see", low=0.0, high=1.0, scale=0.5, shape=True, detail=True, typical=(0.0, 1.0)
    )

    name = "field_diffusion"
    block = "coil"
    law = "k dB/dt -> k [(1 - kappa) mean_j dB_j/dt + kappa mean_j D_ij dB_j/dt] in shell i, D_ij = mean of -2 ln max(u, u'), u = (r/R)^2; strain by mean m^2, in detail less alike var m"
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

    def share(self):
        """The share in use: `kappa`, kept between -BELOW and 1."""
        above = KNEE + (1 - KNEE) * jnp.tanh((self.kappa - KNEE) / (1 - KNEE))
        return jnp.where(self.kappa > KNEE, above, jnp.where(self.kappa < 0, BELOW * jnp.tanh(self.kappa / BELOW), self.kappa))
