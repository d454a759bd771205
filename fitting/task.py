"""What all fits of one diagnosis share: the recordings, their bench, what was chosen, who is told, and when the search ends."""

import dataclasses
import time
from collections.abc import Callable

import numpy as np

from magjax.bench import Bench

from .attribute import chi2_of
from .finer import REFINE_BELOW
from .fit import fit_or_stop
from .model import whitened
from .setup import Choices, effect_parameters


def freed_beyond(result) -> tuple[str, ...]:
    """Names of what a fit frees beyond its bench file: effects' parameters, a sensor's zero."""
    return tuple(n for n in result.problem.layout.names if n not in result.bench.free)


OFF = 3.0  # times what a fit leaves, that its model leaves after the fewest periods where it is far from settled then


def periods_from(result):
    """Periods that a fit begins with which goes on from another: those of that one. Where physics is missing its model may have been led to
    a loss that takes many to settle, which an effect makes needless: there with the fewest, and it goes on with more where it takes them;
    unless the model itself is far off after so few, for then the first steps go to what has not settled, and may not come back."""
    fewest = Choices().periods
    if result.chi2_per_sample <= REFINE_BELOW or _far_off(result, fewest):
        return result.choices.periods
    return fewest


def _far_off(result, fewest: int) -> bool:
    """Whether a fit's model is far from settled after the `fewest` periods."""
    if np.max(result.choices.periods) <= fewest:
        return False
    passes, predictor = result.problem.passes, result.problem.predictors[1]
    brief = dataclasses.replace(predictor, periods=tuple(min(fewest, n) for n in predictor.periods))
    misfit = whitened(passes.lines(result.solution.z, brief), passes.target, np)
    return not float(np.sum(misfit**2)) < OFF * chi2_of(result)


LATE = 0.6  # of the time, after which nothing is begun anew,
SEARCHED = 0.8  # and the search for effects ends: a function is to be learned where they explain too little


class Late(Exception):
    """Raised by a search whose time is over."""


class Clock:
    """When a diagnosis ends, `minutes` from now, or never, from when on it begins nothing anew, and when its search for effects ends;
    `cut`: whether anything was left out for want of time."""

    def __init__(self, minutes: float = np.inf):
        now = time.monotonic()
        self.end, self.cut = now + 60 * minutes, False
        self.late, self.searched = now + LATE * 60 * minutes, now + SEARCHED * 60 * minutes

    def check(self, end: float):
        """Raise `Late` after a time, `end`, `late` or `searched`."""
        if time.monotonic() > end:
            self.cut = True
            raise Late


@dataclasses.dataclass(frozen=True)
class Task:
    """Recordings of a bench to be fitted; `actuator`: what the user gave to start from, or None."""

    recordings: tuple
    bench: Bench
    choices: Choices = Choices()
    progress: Callable | None = None
    actuator: object = None
    clock: Clock = dataclasses.field(default_factory=Clock)
    ends: float = np.inf  # time.monotonic() after which it raises `Late`

    @property
    def timed(self):
        """The same, ended by its clock: what is to begin or goes on then raises `Late`."""
        return self._until(self.clock.end)

    @property
    def searching(self):
        """The same, of the search for effects: ended while there is time to learn a function in their place."""
        return self._until(self.clock.searched)

    @property
    def sparing(self):
        """The same, of what a diagnosis begins anew with: ended while there is time for the rest of it."""
        return self._until(self.clock.late)

    def _until(self, end):
        def say(*words):
            self.clock.check(end)
            if self.progress is not None:
                self.progress(*words)

        return self.on(progress=say, ends=end)

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
        self.clock.check(self.ends)
        actuator = self.actuator if actuator is None else actuator
        usual = {"extra": effect_parameters(actuator), "choices": self.choices, "progress": self.progress}
        return fit_or_stop(self.recordings, self.bench, actuator=actuator, **{**usual, **more})

    def fit_on(self, start, actuator=None, **more):
        """`fit` from where another fit of the same recordings ended, on its spectra, without another density; as `periods_from` it,
        where no choices are given."""
        usual = {"choices": dataclasses.replace(self.choices, periods=periods_from(start))}
        return self.fit(actuator, **{**usual, "start": start, "spectra": start.spectra, "refine": False, **more})
