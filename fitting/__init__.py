"""Data against physics: the joint fit and the diagnosis. Imports magjax, never the reverse."""

import sys
from types import ModuleType

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


class _Package(ModuleType):
    """`fitting.fit` and `fitting.diagnose` are the functions, whatever was imported before: no module of that name takes their place."""

    def __setattr__(self, name, value):
        super().__setattr__(name, getattr(value, name) if name in _HOMES and isinstance(value, ModuleType) else value)


sys.modules[__name__].__class__ = _Package
