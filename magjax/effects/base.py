"""What an effect is: one piece of physics in one block that T&B leave out.

At its null the extended model is the base but for rounding (2e-15 relative): write laws in increment form, x + k * (...). An effect
overrides the hooks of its block only; all others are identities. Adding one is one new file and two lines in `__init__.py`.

hook            block                   acts on
drive           source                  the current on its way to the coil (whole signal)
delivered       source                  the same, where the flux answers it (whole signal, after the step)
field_shift     source, coil, hysteresis  the field inside the implicit step of (4)
magnetization   hysteresis              what is added to the Preisach magnetization inside the step
strain          magnetostriction        the free displacement (whole signal)
displacement    mechanics               the displacement (whole signal)
reading         sensor                  the reading (whole signal; `line.time` runs over the record for `record_level` ones)
"""

import dataclasses
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..param import parameters_of


class Trial(NamedTuple):
    """What an in-step effect sees at a trial value of the field: SI scalars.

    `field`: the field that the relays see. `magnetization`: of the Preisach operator. `flux_rate`: dB/dt, T/s, of the
    step. `field_rate`: of the relays' field, A/m/s. `current`: A, drive at the end of the step. `h`: step, s.
    """

    field: object
    magnetization: object
    flux_rate: object
    field_rate: object
    current: object
    h: object


class AbstractEffect(eqx.Module):
    """Base of every effect. Class attributes:

    `name`, `block` (one of chain.BLOCKS), `law` (the equation), `source` (literature), `signature` (how it shows in
    data), `in_step` (solved inside the step of (4)), `slow` (its state takes longer than
    a few periods: `settled` leads it to where it repeats), `record_level` (acts on the whole record, not period by period),
    `amplitude` (the parameter whose null removes the effect), `shells` (into so many the rod is cut, see chain.shells; 0: not),
    `forms` (classes of the same name with another form of the law, which a fit may reach by `elsewhere`; each says its `form`),
    `magnetic` (it means nothing in a stack under voltage, as all of the coil and of the magnetostriction do).
    """

    name: ClassVar[str] = ""
    block: ClassVar[str] = ""
    law: ClassVar[str] = ""
    source: ClassVar[str] = ""
    signature: ClassVar[str] = ""
    amplitude: ClassVar[str] = ""
    in_step: ClassVar[bool] = False
    slow: ClassVar[bool] = False
    record_level: ClassVar[bool] = False
    shells: ClassVar[int] = 0
    forms: ClassVar[tuple] = ()
    form: ClassVar[str] = ""
    magnetic: ClassVar[bool] = False

    def with_amplitude(self, value):
        """The same effect with its amplitude parameter replaced."""
        return eqx.tree_at(lambda e: getattr(e, self.amplitude), self, jnp.asarray(value, dtype=float))

    @classmethod
    def serves(cls, actuator) -> bool:
        """Whether it can act in this actuator: a stack under voltage has no coil and no magnetostriction."""
        return actuator.coil.drive != "voltage" or cls.electric()

    @classmethod
    def electric(cls) -> bool:
        """Whether it means anything in a stack under voltage."""
        return not (cls.magnetic or cls.block in ("coil", "magnetostriction"))

    @classmethod
    def parameters(cls):
        """Declared parameters: name -> ParameterInfo."""
        return parameters_of(cls)

    def free_parameters(self) -> tuple[str, ...]:
        """Names of what a fit frees: all but what is given and the details of the law, while these are at their defaults."""
        known = {n: info for n, info in self.parameters().items() if not info.given}
        plain = all(float(getattr(self, n)) == info.default for n, info in known.items() if info.detail)
        return tuple(n for n, info in known.items() if not (plain and info.detail))

    def in_detail(self):
        """The same with the details of its law free, off zero by their scale; None where it has none or they are free already."""
        kept = {n: info for n, info in self.parameters().items() if info.detail}
        if not kept or set(kept) & set(self.free_parameters()):
            return None
        return dataclasses.replace(self, **{n: info.scale for n, info in kept.items() if info.default == 0})

    def is_itself(self) -> bool:
        """Whether its parameters are those of what it is named for: elsewhere its law may imitate what it is not."""
        return True

    def is_seen(self, highest: float) -> bool:
        """Whether recordings whose lines end at `highest`, Hz, reach what it is named for: below it its law may imitate what it is not."""
        return True

    @classmethod
    def elsewhere(cls, actuator) -> tuple:
        """Where else a fit may begin, far from the null, for laws whose first order misleads: effects with all their parameters, beside those
        of an actuator."""
        return ()

    @classmethod
    def seen_in(cls, readings) -> dict:
        """What is given it by the recordings that it is to be fitted to; `readings`: their lowest and highest."""
        return {}

    @property
    def marches(self) -> bool:
        """Whether it changes the field or the magnetization: all that stand before the magnetostriction do."""
        return self.in_step or self.shells > 0 or self.block == "source"

    @classmethod
    def finite_trials(cls, drives, fluxes, steps):
        """For an effect without a derivative at null: parameters at which the screening tries it, else None.

        A row each recording, of a period: `drives`, A, and `fluxes`, the rod's flux density without it, T, (samples,); `steps`, s.
        """
        return None

    def drive(self, current, line, actuator):
        """Current after this effect, A, (time,)."""
        return current

    def delivered(self, current, flux_density, line, actuator):
        """Current in the coil, A, (time,), where an effect inside the step changes it; `flux_density`: T, (time,)."""
        return current

    def start(self, trial: Trial, actuator):
        """Internal state at equilibrium before the first step: any tuple of scalars, or of arrays whose last axes are those of `trial.field`."""
        return ()

    def field_shift(self, trial: Trial, state, actuator):
        """What must be added to the relays' field to give the field H in (4), A/m; a loss if the block is the source or the coil."""
        return jnp.zeros_like(trial.field)

    def magnetization(self, trial: Trial, state, actuator):
        """Magnetization beside the Preisach operator's, A/m."""
        return jnp.zeros_like(trial.field)

    def advance(self, trial: Trial, state, actuator):
        """Internal state after the step."""
        return state

    def settled(self, state, before, period):
        """For slow effects: the state that repeats, from those at the end and at the beginning (`before`) of a `period`, s."""
        return state

    def strain(self, free_displacement, magnetization, field, line, actuator):
        """Free displacement after this effect, m, (time,)."""
        return free_displacement

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        """Displacement after this effect, m, (time,); `signals` holds current, field, magnetization, flux_density."""
        return displacement

    def reading(self, reading, signals, line, actuator):
        """Reading after this effect, unit of the sensor, (time,)."""
        return reading
