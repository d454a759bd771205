"""What an emulated bench answers to a drive: a plain amplifier for tests, or the bench model with concealed effects.

The bench's material remembers its runs (material.py): what a drive leaves behind is where the next one starts.
"""

import numpy as np

from ..errors import ConfigurationError
from .material import Material

REST = 50e-6  # m: where the middle of the displacement converter lies


def converter(displacement_noise: float, current_noise: float) -> list[dict]:
    """Two 16-bit channels: the shunt and the displacement sensor; noise rms in SI."""
    return [
        {"name": "current", "unit": "A", "scale": 5e-5, "offset": 0.0, "noise": current_noise},
        {"name": "displacement", "unit": "um", "scale": 100.0 / 2**16, "offset": 1e6 * REST, "noise": displacement_noise},
    ]


class PlainResponse:
    """No physics: the current is the drive, the displacement follows it at 20 um/A; starts at once. `exact`: no noise."""

    def __init__(self, exact: bool = False):
        self.channels = converter(0.0 if exact else 40e-9, 0.0 if exact else 1e-4)

    def prepare(self, drive, rate, repeats, samples):
        """Readings for a drive in A, (time, 2), SI: nothing before the period."""
        period = np.stack([drive, REST + 20e-6 * drive], axis=1)
        if not repeats:
            return period[:0], period
        rest = np.array([[0.0, REST]])
        return np.tile(period, (repeats, 1)), rest

    def ended(self, samples) -> None:
        """The run is over after so many samples: there is nothing to remember."""


class BenchResponse:
    """The bench model with other constants and concealed effects, as `fitting.demo` conceals them.

    `hidden`: effect name -> its parameters. `shift`: s by which the displacement is read late beside the current.
    """

    def __init__(self, bench, hidden: dict, *, actuator=None, displacement_noise=40e-9, current_noise=1e-4, shift=0.0):
        from ..cli.runtime import prepare_jax

        prepare_jax()
        self.actuator = bench.actuator() if actuator is None else actuator
        for name, parameters in hidden.items():
            self.actuator = self.actuator.with_effect(effect_of(name, parameters))
        if self.actuator.output != "displacement":
            raise ConfigurationError(
                f"bench {bench.name} ends at {self.actuator.output}; the emulator needs one that ends at displacement"
            )
        self.channels = converter(displacement_noise, current_noise)
        self.shift = shift
        past, h = self.actuator.hysteresis.rested(), self.actuator.hysteresis
        rest = float(self.actuator.coil.applied_field(0.0))
        self.material = Material(np.asarray(h.masses), float(h.low), float(h.high), rest, np.asarray(past.history))
        self.fields = None

    def prepare(self, drive, rate, repeats, samples):
        """Readings for a drive in A: the first periods from rest, then the steady period."""
        if np.ptp(drive) == 0:
            drive = drive + np.linspace(0, 1e-9, len(drive))
        few = self.material.few()
        if repeats == 1:
            start, first = self._run(drive, rate, few, self.material.start(few))
            self.fields = first, first[-1:]
            return start, start[-1:] * 1.0
        steady, again = self._run(drive, rate)
        for _ in range(2):  # a second time for benches whose field depends on M
            lowest, highest = float(again.min()), float(again.max())
            level = self.material.level(self.material.past, lowest, highest)
            steady, again = self._run(drive, rate, level=level)
        start, first = self._run(np.tile(drive, 2), rate, few, level - self.material.level(few, lowest, highest))
        self.fields = first, again
        if any(e.record_level for e in self.actuator.effects) and samples:
            return self._whole(start, steady, rate, samples), steady
        if repeats:
            return np.concatenate([start, np.tile(steady, (max(repeats - 2, 0), 1))])[: repeats * len(drive)], steady[-1:]
        return start, steady

    def ended(self, samples) -> None:
        """The run is over after so many samples, and the drive at zero: the material remembers it."""
        if self.fields is None:
            return
        first, period = self.fields
        more = samples - len(first)
        if more > 0:
            first = np.concatenate([first, period, period[: more % len(period)]])
        self.material.run(first[:samples] if more <= 0 else first)
        self.fields = None

    def _run(self, drive, rate, history=None, level=0.0):
        """(readings (time, 2), fields that the relays see (time,)) of a drive: periodic, or after a history; M raised by `level`."""
        from ..simulate import simulate

        periodic = history is None
        instant = [e for e in self.actuator.effects if not e.record_level]
        actuator = self.actuator
        for effect in actuator.effects:
            actuator = actuator.without_effect(effect.name)
        for effect in instant:
            actuator = actuator.with_effect(effect)
        actuator = actuator.remembering([] if periodic else history, level)
        signals = simulate(actuator, drive, 1 / rate, periodic=periodic)
        reading = np.asarray(signals.reading)
        if self.shift:
            at = np.arange(len(drive)) - self.shift * rate
            reading = np.interp(at, np.arange(len(drive)), reading, period=len(drive) if periodic else None)
        return np.stack([np.asarray(signals.current), reading], axis=1), np.asarray(signals.relay_field)

    def _whole(self, start, steady, rate, samples):
        """The whole record, with drift, heat and hum over its time."""
        from ..chain import Timeline

        body = np.concatenate([start, np.tile(steady, (int(samples) // len(steady) + 1, 1))])[: int(samples)]
        line = Timeline(1 / rate, len(body), False)
        reading = body[:, 1]
        for effect in self.actuator.effects:
            if effect.record_level:
                reading = effect.reading(reading, {"current": body[:, 0], "displacement": body[:, 1]}, line, self.actuator)
        return np.stack([body[:, 0], np.asarray(reading)], axis=1)


def effect_of(name: str, parameters: dict):
    """An effect of the catalogue by name; raises `ConfigurationError` naming what there is."""
    from ..effects import form_of, forms_of, refuse_unknown

    refuse_unknown([name])
    kind = form_of(name, parameters)
    known = kind.parameters()
    for key, value in parameters.items():
        if key not in known:
            has = " or ".join(", ".join(form.parameters()) for form in forms_of(name))
            raise ConfigurationError(f'effect {name} has no parameter "{key}"; it has {has}')
        if not known[key].low <= value <= known[key].high or not np.isfinite(value):
            raise ConfigurationError(
                f"effect {name}: {key} = {value:g}; give {known[key].low:g} to {known[key].high:g} {known[key].unit}"
            )
    amplitude = kind.amplitude
    if amplitude not in parameters:
        typical = known[amplitude].typical or (known[amplitude].scale,) * 2
        parameters = {amplitude: float(np.sqrt(abs(typical[0] * typical[1]))), **parameters}
    return kind(**parameters)
