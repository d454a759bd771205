"""What the errors of a fit mean for the inversion: standard errors of the Preisach masses, and T&B Prop. 4.1 with them."""

import numpy as np

from .uncertainty import WIDEN, covariance

AT_ONCE = 1000  # cells


def mass_errors(result) -> np.ndarray:
    """Standard errors of the masses of a `FitResult`, A/m, in the shape of `actuator.hysteresis.masses`; none where they are held.

    The masses are total * (cells @ x) of the hats' heights x, so their covariance is that of x carried through.
    """
    layout = result.problem.layout
    if layout.held is not None:
        return np.zeros(layout.held.shape)
    n = layout.density_unknowns
    hats = covariance(result.solution.normal, result.solution.z, layout)[:n, :n]
    cells, side = result.problem.basis.cells.tocsr(), layout.hats.size
    parts = [cells[k : k + AT_ONCE] for k in range(0, side * side, AT_ONCE)]
    variance = np.concatenate([part.multiply(part @ hats).sum(axis=1) for part in parts])
    return WIDEN * float(layout.total) * np.sqrt(np.maximum(variance, 0.0)).reshape(side, side)


def inversion_bound(result):
    """Prop. 4.1 for a `FitResult`: a `magjax.inverse.bounds.Bound` of the inversion's error in M, A/m."""
    from magjax.inverse import PlainActuator
    from magjax.inverse.bounds import static_bound

    return static_bound(PlainActuator.from_actuator(result.actuator), mass_errors=mass_errors(result))
