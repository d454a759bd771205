"""Robust tracking control on the inverted actuator, T&B Sec. 4: l1 design, realization, python-control models, studies.

Plain NumPy and SciPy; python-control is imported where it is needed (it costs a second).
"""

from .l1 import Design, TrackingProblem, design
from .sensitivity import Optimum, optimal_sensitivity

__all__ = ["Design", "Optimum", "TrackingProblem", "design", "optimal_sensitivity"]
