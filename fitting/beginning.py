"""What a diagnosis begins with; and what shows only beside an effect, that it begins anew with."""

import contextlib
import dataclasses

from .own_signals import heat_on_harmonics, hum_on_harmonics, own_zeros, unsettled_means
from .plain import better_valley
from .result import FitResult
from .task import Late, Task


@dataclasses.dataclass(frozen=True)
class Beginning:
    """Recordings, the task's, without the record-level effects `adopted`, each with its rivals; `measured`: the task with them as
    they came; `check`: the check recordings as they came; `plain`: a fit of theirs, where it is known; `before_means`: the beginning
    before means of the recordings were set free; `means`: whether these may be."""

    task: Task
    measured: Task
    adopted: tuple
    check: list
    plain: FitResult | None = None
    before_means: "Beginning | None" = None
    means: bool = True

    def on(self, **changes):
        """The same with another task, check recordings or plain fit."""
        return dataclasses.replace(self, **changes)

    def with_cleaned(self, cleaned, adopted, **more):
        """From recordings that were cleaned of what is adopted."""
        return self.on(
            task=self.task.on(recordings=cleaned.recordings),
            adopted=tuple(adopted),
            **{"plain": None, "before_means": None, **more},
        )

    def without_hum_or_heat(self, task, fit, candidates=()):
        """The task without hum or heat that shows in what a fit leaves, all that is adopted then, and its plain fit; None where there is
        none."""
        if found := hum_on_harmonics(task, self.adopted, fit, candidates):
            cleaned, hum, freed = found
            return cleaned, [*self.adopted, hum], freed
        return heat_on_harmonics(task, self.adopted, fit, candidates)

    def from_plain(self, plain, candidates):
        """From recordings without hum or heat that shows in what the plain fit leaves; None where there is none."""
        if found := self.without_hum_or_heat(self.task, plain, candidates):
            cleaned, adopted, freed = found
            return self.with_cleaned(cleaned, adopted, plain=freed)
        return None

    def with_own_means(self, plain, candidates):
        """Means of their own in place of effects; None where these serve as well."""
        if self.means and (found := own_zeros(self.task, self.adopted, plain, candidates)):
            cleaned, own, freed = found
            return self.with_cleaned(cleaned, [*self.adopted, own], plain=freed, before_means=self)
        return None


class Anew:
    """Asked by a search beside each effect that it takes; `found`: the beginning that a diagnosis begins anew with, None for none.

    `begun`: its beginning, with its plain fit and `candidates`; `zero`: whether that has a zero of the sensor's, beside which neither the
    plain fit nor means are asked for again."""

    def __init__(self, begun: Beginning, candidates, zero: bool):
        self.begun, self.candidates, self.zero, self.found = begun, candidates, zero, None

    def __call__(self, current) -> bool:
        """Whether hum or heat shows beside the effects of a fit, or the plain one was in a false valley."""
        begun, task = self.begun, self.begun.task.sparing
        with contextlib.suppress(Late):
            if found := begun.without_hum_or_heat(task, current):
                self.found = begun.with_cleaned(*found[:2])
            elif not self.zero and (better := better_valley(task, begun.plain, self.candidates, current)):
                self.found = begun.on(plain=better)
        return self.found is not None

    def means(self, fit, best, beside=()) -> bool:
        """Whether means of the recordings are to be set free: see `unsettled_means`."""
        begun = self.begun
        with contextlib.suppress(Late):
            if begun.means and not self.zero and (found := unsettled_means(begun.task.sparing, begun.adopted, fit, best, beside)):
                self.found = begun.with_cleaned(found[0], [*begun.adopted, found[1]], before_means=begun)
        return self.found is not None
