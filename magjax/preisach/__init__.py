"""Hysteresis: the Preisach plane, its Everett table, the memory, the relay grid with its surrogates."""

from .densities import (
    density_masses,
    factorised_masses,
    forc_masses,
    gaussian_lorentzian_masses,
    uniform_masses,
)
from .memory import Memory, memory_after, saturated_memory
from .operator import Preisach
from .relays import relay_magnetization

__all__ = [
    "Memory",
    "Preisach",
    "density_masses",
    "factorised_masses",
    "forc_masses",
    "gaussian_lorentzian_masses",
    "memory_after",
    "relay_magnetization",
    "saturated_memory",
    "uniform_masses",
]
