"""The signal chain, one block a file, in the order in which the signal runs.

commanded current -> source -> coil -> hysteresis (magjax.preisach) -> magnetostriction -> mechanics -> sensor -> reading
of a piezo stack: voltage -> source -> electrodes -> hysteresis -> piezo -> mechanics -> sensor -> reading
"""

from .coil import Coil, FieldCoil
from .magnetostriction import Magnetostriction
from .mechanics import Mechanics
from .piezo import Electrodes, Piezo
from .sensor import Sensor
from .source import Source
from .timeline import Timeline

BLOCKS = ("source", "coil", "hysteresis", "magnetostriction", "piezo", "mechanics", "sensor")

__all__ = ["BLOCKS", "Coil", "Electrodes", "FieldCoil", "Magnetostriction", "Mechanics", "Piezo", "Sensor", "Source", "Timeline"]
