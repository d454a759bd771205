"""Constants of nature used throughout."""

import math

MU0 = 4e-7 * math.pi  # H/m, vacuum permeability, the value T&B use below (3)
