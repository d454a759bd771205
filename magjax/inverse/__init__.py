"""Exact inversion of the Preisach operator and of the dynamic model, in plain NumPy (T&B Sec. 3)."""

from .dynamic import PlainActuator, current_for_displacement, implicit_euler
from .operator import PlainPreisach
from .stack import PlainStack, voltage_for_displacement

__all__ = ["PlainActuator", "PlainPreisach", "PlainStack", "current_for_displacement", "implicit_euler", "voltage_for_displacement"]
