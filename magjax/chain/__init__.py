"""The signal chain, one block a file, in the order in which the signal runs.

commanded current -> source -> coil -> hysteresis (magjax.preisach) -> magnetostriction -> mechanics -> sensor -> reading
"""

from .coil import Coil, FieldCoil
from .magnetostriction import Magnetostriction
from .mechanics import Mechanics
from .sensor import Sensor
from .source import Source
from .timeline import Timeline

BLOCKS = ("source", "coil", "hysteresis", "magnetostriction", "mechanics", "sensor")

__all__ = ["BLOCKS", "Coil", "FieldCoil", "Magnetostriction", "Mechanics", "Sensor", "Source", "Timeline"]
