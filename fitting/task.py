"""What all fits of one diagnosis share: the recordings, their bench, what was chosen, who is told, and when the search ends."""

import dataclasses
import time
from collections.abc import Callable

import numpy as np

from magjax.bench import Bench

from .fit import fit_or_stop
from .setup import Choices, effect_parameters


def freed_beyond(result) -> tuple[str, ...]:
    """Names of what a fit frees beyond its bench file: effects' parameters, a sensor's zero."""
    return tuple(n for n in result.problem.layout.names if n not in result.bench.free)


class Late(Exception):
    """Raised by the next word of a search whose time is over."""


class Clock:
    """When a search ends, `minutes` from now, or never; `cut`: whether it was ended before it was through."""

    def __init__(self, minutes: float = np.inf):
        self.end, self.cut = time.monotonic() + 60 * minutes, False

    @property
    def over(self) -> bool:
        """Whether the time is over."""
        return time.monotonic() > self.end

    def within(self, progress):
        """The progress function that raises `Late` once the time is over."""

        def say(*words):
            if self.over:
                self.cut = True
                raise Late
            if progress is not None:
                progress(*words)

        return say


@dataclasses.dataclass(frozen=True)
class Task:
    """Recordings of a bench to be fitted; `actuator`: what the user gave to start from, or None."""

    recordings: tuple
    bench: Bench
    choices: Choices = Choices()
    progress: Callable | None = None
    actuator: object = None
    clock: Clock = dataclasses.field(default_factory=Clock)

    @property
    def timed(self):
        """The same, ended by its clock: at its next word a fit raises `Late`."""
        return self.on(progress=self.clock.within(self.progress))

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
