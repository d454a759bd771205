"""Exact inversion of the Preisach operator and of the dynamic model, in plain NumPy (T&B Sec. 3)."""

from .dynamic import PlainActuator, current_for_displacement, implicit_euler
from .operator import PlainPreisach

__all__ = ["PlainActuator", "PlainPreisach", "current_for_displacement", "implicit_euler"]
