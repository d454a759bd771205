"""Data against physics: the joint fit and the diagnosis. Imports magjax, never the reverse."""

__all__ = ["Choices", "Diagnosis", "FitResult", "diagnose", "fit"]

_HOMES = {"Choices": "setup", "Diagnosis": "diagnose", "FitResult": "result", "diagnose": "diagnose", "fit": "fit"}


def __getattr__(name):
    """Names of the public interface, imported when first asked for (JAX takes half a second)."""
    if name not in _HOMES:
        raise AttributeError(f"module fitting has no attribute {name}")
    import importlib

    value = getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
    globals()[name] = value
    return value
