"""Read a fitted actuator back from model.json, bit for bit."""

import json
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .bench import OUTPUTS, Bench
from .errors import ConfigurationError
from .preisach import Preisach
from .terms import LIMITS


def load_model(folder):
    """(actuator, bench) from a result folder or its model.json; raises `ConfigurationError` naming the file and what is wrong."""
    path = Path(folder)
    path = path / "model.json" if path.is_dir() else path
    try:
        return _model(json.loads(path.read_text(encoding="utf-8")))
    except ConfigurationError as error:
        raise ConfigurationError(f"{path}: {error}; mend it there, or fit again") from None
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise ConfigurationError(f"{path}: not a fitted model ({error}); give the folder that magjax fit wrote") from None
    except KeyError as error:
        raise ConfigurationError(f"{path}: not a fitted model (no {error}); give the folder that magjax fit wrote") from None


def _model(content):
    from .effects import form_of
    from .effects.learned_term import LearnedTerm

    stated = dict(content["bench"])
    for key in ("blocks", "free"):
        stated[key] = tuple(stated[key])
    if isinstance(stated["start"], list):
        stated["start"] = tuple(stated["start"])
    bench = Bench(**stated)
    for key, value, known in (("output", bench.output, OUTPUTS), ("drive", bench.drive, tuple(LIMITS))):
        if value not in known:
            raise ConfigurationError(f"bench.{key} = {value!r} is unknown; known are {', '.join(known)}")
    actuator = bench.actuator()
    plane = content["hysteresis"]
    hysteresis = Preisach(np.asarray(plane["masses"]), plane["low"], plane["high"], plane["offset"], rest=plane.get("rest"))
    hysteresis = eqx.tree_at(lambda h: h.history, hysteresis, jnp.asarray(plane["history"], dtype=float))
    actuator = eqx.tree_at(lambda a: a.hysteresis, actuator, hysteresis)
    stated = content["parameters"]
    for name in content["effects"]:
        keys = [n.rsplit(".", 1)[1] for n in stated if n.startswith(f"effects.{name}.")]
        effect = LearnedTerm.null(**content[name]) if name == LearnedTerm.name else form_of(name, keys)()
        actuator = actuator.with_effect(effect)
    known = actuator.parameters()
    # shapes have a default, which leaves a law as it was before it had them
    if missing := [n for n, (_, info) in known.items() if n not in stated and info.null is None and not info.shape]:
        raise ConfigurationError(f"parameters lacks {', '.join(missing)}")
    if odd := [n for n in stated if n not in known]:
        raise ConfigurationError(f"parameters holds {', '.join(odd)}, which no block and no effect has: of another version")
    masses = np.asarray(plane["masses"], float)
    numbers = {**stated, **{f"hysteresis.{k}": plane[k] for k in ("low", "high", "offset")}, "hysteresis.masses": masses.sum()}
    numbers["hysteresis.history"] = np.asarray(plane["history"], float).sum()
    if odd := [name for name, value in numbers.items() if not np.isfinite(value)]:
        raise ConfigurationError(f"{odd[0]} is not a finite number")
    for name, (_, info) in known.items():
        if name in stated and not name.startswith("effects.") and not info.low <= stated[name] <= info.high:
            raise ConfigurationError(f"{name} = {stated[name]:g} is outside {info.low:g} .. {info.high:g}")
    return actuator.replace(stated), bench
