"""Acquisition: serial protocol, crash-safe log, recorder, emulated bench, campaign and investigation. NumPy only."""
