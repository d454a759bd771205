"""An actuator made independently from the equations of Tan and Baras (2004), in plain NumPy and SciPy.

`ConcealedBench` in `bench.py` ties the blocks together: `density` (play operators), `coil` (4), `strain`, `rod` (5), `sensor`,
`instruments`.
"""
