"""What all fits of one diagnosis share: the recordings, their bench, what was chosen, and who is told."""

import dataclasses
from collections.abc import Callable

from magjax.bench import Bench

from .fit import fit_or_stop
from .setup import Choices, effect_parameters


def freed_beyond(result) -> tuple[str, ...]:
    """Names of what a fit frees beyond its bench file: effects' parameters, a sensor's zero."""
    return tuple(n for n in result.problem.layout.names if n not in result.bench.free)


@dataclasses.dataclass(frozen=True)
class Task:
    """Recordings of a bench to be fitted; `actuator`: what the user gave to start from, or None."""

    recordings: tuple
    bench: Bench
    choices: Choices = Choices()
    progress: Callable | None = None
    actuator: object = None

    @property
    def held(self) -> tuple[str, ...]:
        """Names of the effects' parameters of the actuator that was given."""
        return effect_parameters(self.actuator)

    def on(self, **changes):
        """The same with other recordings, choices or progress."""
        return dataclasses.replace(self, **changes)

    def say(self, text: str, chi2: float | None = None):
        """Tell what begins now."""
        if self.progress is not None:
            self.progress(text, 0, chi2)

    def fit(self, actuator=None, **more):
        """`fit` of an actuator, the given one if None, with all of its effects free; `more`: its further options. Ctrl-C is raised."""
        actuator = self.actuator if actuator is None else actuator
        usual = {"extra": effect_parameters(actuator), "choices": self.choices, "progress": self.progress}
        return fit_or_stop(self.recordings, self.bench, actuator=actuator, **{**usual, **more})

    def fit_on(self, start, actuator=None, **more):
        """`fit` from where another fit of the same recordings ended, on its spectra, without another density."""
        return self.fit(actuator, **{"start": start, "spectra": start.spectra, "refine": False, **more})
