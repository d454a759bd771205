"""magjax: differentiable simulation, identification and control of hysteretic magnetostrictive actuators.

The science is X. Tan and J. S. Baras, "Modeling and control of hysteresis in magnetostrictive actuators",
Automatica 40 (2004), cited as T&B; equation numbers in the code are theirs.
"""

__version__ = "0.1.0"
