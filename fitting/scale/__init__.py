"""Many fits: bootstrap and profile intervals of one fit, fleets of actuators. All go through `magjax.scale.run_job`."""

__all__ = ["Bootstrap", "Fleet", "Profile", "bootstrap_intervals", "fit_fleet", "profile_intervals"]

_HOMES = {
    "Bootstrap": "bootstrap", "bootstrap_intervals": "bootstrap", "Profile": "profile", "profile_intervals": "profile",
    "Fleet": "fleet", "fit_fleet": "fleet",
}  # fmt: skip


def __getattr__(name):
    """Names of the public interface, imported when first asked for."""
    if name not in _HOMES:
        raise AttributeError(f"module fitting.scale has no attribute {name}")
    import importlib

    return getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
