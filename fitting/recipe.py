"""T&B's own identification of R_eddy and xi, Sec. 2.3 Steps 1-3, from the phase lags of the fundamentals.

For each R_eddy of a mesh, (4) is integrated; the lag of y behind the simulated M^2 must be that of (5), which gives a
xi for each frequency. The R_eddy under which these xi vary least is taken, and their mean: the table behind Fig. 6.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from magjax.errors import ConfigurationError
from magjax.programs import seldom
from magjax.simulate import run_chain

from .spectra import reduce_recording


@dataclasses.dataclass(frozen=True)
class LagTable:
    """`xi`: (resistances, frequencies); `R_eddy` (ohm) and `damping_ratio` that the recipe picks; `variance`: of each row."""

    resistances: np.ndarray
    frequencies: np.ndarray
    xi: np.ndarray
    variance: np.ndarray
    R_eddy: float
    damping_ratio: float

    def __str__(self):
        step = np.argmin(np.abs(self.resistances - self.R_eddy))
        about = float(np.diff(self.resistances)[max(step - 1, 0)])
        return (
            f"T&B's recipe (Sec. 2.3) on {len(self.frequencies)} single tones, with this density and f0: R_eddy = {self.R_eddy:.4g} ohm "
            f"(mesh of {about:.2g} ohm), xi = {self.damping_ratio:.4g} +- {np.sqrt(self.variance.min()):.2g} between frequencies"
        )

    def as_dict(self) -> dict:
        """Plain lists."""
        return {k: (v.tolist() if isinstance(v, np.ndarray) else v) for k, v in dataclasses.asdict(self).items()}


SINGLE = 0.05  # of the fundamental, that another line of the drive may reach in a single tone
MESH = np.geomspace(0.5, 2.0, 29)  # of the fitted R_eddy


def recipe_beside(result, recordings) -> LagTable:
    """The recipe on the single-tone recordings of a fit, with the fitted density and f0, on a mesh about its R_eddy."""
    if result.bench.output != "displacement" or "coil.R_eddy" not in result.actuator.parameters():
        raise ConfigurationError("T&B's recipe wants an actuator with R_eddy and mechanics, current in and displacement out")
    tones = [
        r
        for r, s in zip(recordings, result.spectra, strict=True)
        if np.abs(s.drive[2:]).max(initial=0.0) < SINGLE * np.abs(s.drive[1])
    ]
    return lag_recipe(tones, result.actuator, float(result.actuator.coil.R_eddy) * MESH)


@seldom
def _square_lags(actuator, drives, steps, resistances):
    """Phase of the fundamental of M^2 against the drive's, rad: (resistances, recordings)."""

    def one(drive, dt, R):
        signals = run_chain(actuator.replace({"coil.R_eddy": R}), drive, dt, 3, 4)
        spectrum = jnp.fft.rfft(jnp.stack([signals.magnetization**2, drive]), axis=1)[:, 1]
        return jnp.angle(spectrum[0] / spectrum[1])

    over_recordings = jax.vmap(one, (0, 0, None))
    return jax.lax.map(lambda R: over_recordings(drives, steps, R), resistances)


def lag_recipe(recordings, actuator, resistances, samples: int = 800) -> LagTable:
    """T&B Sec. 2.3, Steps 1-3, on single-tone recordings of current and displacement.

    `actuator`: its density, f0 and constants are taken as known (Sec. 2.1, and the data sheet); `resistances`: mesh of
    R_eddy, ohm. Raises `ConfigurationError` for a mesh without positive values or for fewer than two frequencies.
    """
    resistances = np.asarray(resistances, float)
    if resistances.ndim != 1 or len(resistances) < 2 or resistances.min() <= 0:
        raise ConfigurationError("the mesh of R_eddy needs two or more positive values, ohm")
    spectra = [reduce_recording(r, "current", "displacement") for r in recordings]
    frequencies = np.array([s.frequency for s in spectra])
    if len(np.unique(np.round(frequencies, 6))) < 2:
        raise ConfigurationError("the recipe compares frequencies: give sines of two frequencies at least")
    phases = np.arange(samples) / samples
    drives = jnp.asarray(np.stack([s.drive_at(phases) for s in spectra]))
    measured = np.array([np.angle(s.reading[1] / s.drive[1]) for s in spectra])
    simulated = np.asarray(_square_lags(actuator, drives, jnp.asarray(1 / (frequencies * samples)), jnp.asarray(resistances)))
    lag = -(measured[None] - simulated)
    ratio = frequencies / float(actuator.mechanics.f0)
    xi = np.tan(lag) * (1 - ratio**2) / (2 * ratio)
    variance = xi.var(axis=1)
    best = int(np.argmin(variance))
    return LagTable(resistances, frequencies, xi, variance, float(resistances[best]), float(xi[best].mean()))
