"""One declaration of a physical parameter: default, unit, meaning, bounds, scale and null.

`param` makes an Equinox field whose metadata feed the documentation, the reports, the bounds of the fit and the
error messages, so that each fact about a parameter stands in one place.
"""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np


@dataclasses.dataclass(frozen=True)
class ParameterInfo:
    """What is known about a physical parameter besides its value.

    `scale` is a typical size (same unit), `null` the value at which an effect vanishes, `shape` marks a parameter that
    means nothing while its effect is at null (a time constant, an exponent), `detail` one of these that the search frees only
    where its effect leaves a misfit, `given` one that is told and never fitted, `prior` the standard deviation
    about its null in a fit, where recordings alone would let it wander, `typical` an expected range, `firm` an amplitude that a fit
    keeps from falling below `low`, where nothing can be simulated.
    """

    unit: str
    meaning: str
    low: float = -math.inf
    high: float = math.inf
    scale: float = 1.0
    null: float | None = None
    shape: bool = False
    detail: bool = False
    given: bool = False
    prior: float | None = None
    typical: tuple[float, float] | None = None
    default: float = 0.0
    firm: bool = False


def as_float_array(value):
    """A JAX float array of the widest enabled precision."""
    return jnp.asarray(value, dtype=float)


def in_numpy(module):
    """The same block with NumPy numbers: what is worked out with it on NumPy signals compiles nothing."""
    return jax.tree.map(np.asarray, module)


def param(
    default,
    unit,
    meaning,
    low=-math.inf,
    high=math.inf,
    scale=None,
    null=None,
    shape=False,
    detail=False,
    given=False,
    prior=None,
    typical=None,
    firm=False,
):
    """Declare a physical parameter as an Equinox field; see `ParameterInfo` for the arguments."""
    size = scale if scale is not None else (abs(default) if default else 1.0)
    info = ParameterInfo(unit, meaning, low, high, size, null, shape, detail, given, prior, typical, default, firm)
    return eqx.field(default_factory=lambda: as_float_array(default), converter=as_float_array, metadata={"param": info})


def parameters_of(module) -> dict[str, ParameterInfo]:
    """The declared parameters of a module (or its class): name -> `ParameterInfo`."""
    return {f.name: f.metadata["param"] for f in dataclasses.fields(module) if "param" in f.metadata}
