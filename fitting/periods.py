"""Led back through the steps of marches, from the last to the first, period by period: what lines ask of each of them."""

import itertools
from typing import NamedTuple

import numpy as np

from magjax.chain.march import AT_FIRST, DISTURBED, ends_taken
from magjax.chain.shells import distribution


class Asked(NamedTuple):
    """What is asked of some steps, for some lines: of (field H, M, its spread) after each, (steps, recordings, 3, lines), of
    (field, M) of every place, (places, recordings, 2, shells, lines), of the state after the last step and of the states of effects at the
    period before, (recordings, numbers, lines) each."""

    after: np.ndarray
    at: np.ndarray
    state: np.ndarray
    later: np.ndarray


class Passed(NamedTuple):
    """What the lines ask of the steps, one by one: `through`, (steps, recordings, numbers, lines), and of parameters, (recordings,
    parameters, lines); of all places, `at`, as in `Asked`; and `left`, (recordings, numbers, lines), for the period before."""

    through: np.ndarray
    parameters: np.ndarray
    at: np.ndarray
    left: np.ndarray


class Backward:
    """The steps of marches, to be gone through from the last to the first.

    Where they are those of the first periods and the last, the last stands for `before` more between them. A state, what effects keep for
    a period and the places from which branches leave a period later, `turned`, go from one period to the next. Places: older ones, those
    of the steps, and those of the period before the last.
    """

    def __init__(self, marched, samples):
        steps = marched.steps
        self.marched, self.samples = marched, samples
        self.number, self.count, self.shells = steps.place.shape
        self.size, self.older, marks = steps.rest.shape[1], steps.moved.shape[1], steps.ended.shape[3]
        self.slopes = steps.slopes.swapaxes(2, 3)  # (recordings, steps, in, out)
        self.marks = slice(self.size - marks, self.size)  # states of effects, of which the end of a later period asks
        total = steps.relay_field.shape[1] - 1
        periods = int(steps.periods[0])  # some of which may not be stored
        self.stored = ends_taken(total + 1, samples)
        self.before, self.place, self.turned = periods - self.count // samples, steps.place, np.zeros((self.number, 0), int)
        self.first = AT_FIRST * samples if self.before else 0  # steps that are gone through by themselves
        if self.before:
            step, between = (
                steps.place - self.older,
                np.zeros((self.number, samples), bool),
            )  # step: of the whole march, at the corner
            earlier = (step >= self.first) & (step < total - samples)
            own = np.where(earlier, self.count + step % samples, step - np.where(step >= self.first, total - self.count, 0))
            self.place = self.older + own
            for k, there in enumerate(earlier):
                between[k, step[k][there] % samples] = True
            self.turned = np.argsort(~between, axis=1, kind="stable")[:, : between.sum(axis=1).max()]

    def nothing(self, lines) -> Asked:
        """Room for what is asked."""
        places, marks = self.older + self.count + (self.samples if self.before else 0), self.marks.stop - self.marks.start
        shapes = (self.count, self.number, 3), (places, self.number, 2, self.shells), (self.number, self.size), (self.number, marks)
        return Asked(*(np.zeros((*shape, lines)) for shape in shapes))

    def asked(self, signals) -> Asked:
        """What the lines ask of the last period."""
        steps, asked, every = self.marched.steps, self.nothing(signals.shape[1]), np.arange(self.number)
        shares = distribution(self.shells)[1]
        relay, mean = steps.relay_field[:, -self.samples :] @ shares, signals[:, :, 1].sum(axis=-1)
        for end, slope in zip((relay.argmax(axis=1), relay.argmin(axis=1)), self.marched.unreached.T, strict=True):
            asked.at[self.older + self.count - self.samples + end, every, 0] += (slope[:, None] * mean)[:, None] * shares[:, None]
        read = np.moveaxis(signals[:, :, :3], (3, 2), (0, 2))
        if self.before:
            asked.after[-self.samples :] = np.roll(read, -1, axis=0)  # the end of a period is its first sample
        else:
            asked.after[-self.samples - 1 : -1] = read
        return asked

    def entering(self, given, asked, at=None) -> Asked:
        """`asked` of the last period, and what the next one asks of it, as `Passed.left`. `at`: what the last one asks of all places: then
        of the first periods."""
        before = self.first - (0 if at is None else self.samples)
        asked = Asked(asked.after, asked.at + (0.0 if at is None else at), asked.state.copy(), asked.later.copy())
        state, later, turned = np.split(given, np.cumsum([self.size, asked.later.shape[1]]), axis=1)
        asked.state[:] += state
        asked.later[:] += later
        turned = turned.reshape(self.number, self.turned.shape[1], 2, self.shells, given.shape[2])
        for k, there in enumerate(self.turned):
            asked.at[self.older + before + there, k] += turned[k]
        return asked

    def each(self) -> Asked:
        """Every number that goes from period to period, as lines."""
        every = self.size + self.marks.stop - self.marks.start + 2 * self.shells * self.turned.shape[1]
        return self.entering(np.broadcast_to(np.eye(every), (self.number, every, every)), self.nothing(every))

    def led(self, asked: Asked, first: bool = False) -> Passed:
        """From the last step to the first: through all, or the last period where it stands for others, or the `first` ones then."""
        number, shells, size, slopes = self.number, self.shells, self.size, self.slopes
        cuts = np.cumsum([0, size, 2 * shells, shells + 2 + DISTURBED, slopes.shape[2] - size - 3 * shells - 2 - DISTURBED])
        state, corners, added, moving = (slice(*ends) for ends in itertools.pairwise(cuts))
        lines, every, at, later = asked.after.shape[3], np.arange(number), asked.at.copy(), asked.later
        begin, end = (0, self.first) if first else (self.first, self.count)
        through, parameters = np.empty((end - begin, number, added.stop - added.start, lines)), 0.0
        out, back = np.zeros((number, slopes.shape[3], lines)), np.empty((number, slopes.shape[2], lines))
        out[:, :size] = asked.state
        for t in range(end - 1, begin - 1, -1):
            out[:, size:-3] = at[self.older + t].reshape(number, 2 * shells, lines)
            out[:, -3:] = asked.after[t]
            if (t + 1) % self.samples == 0:
                out[:, self.marks] += later
                later = self.marched.steps.ended[:, t // self.samples].swapaxes(1, 2) @ out[:, :size]
            np.matmul(slopes[:, t], out, out=back)
            out[:, :size], through[t - begin] = back[:, state], back[:, added]
            left = back[:, corners].reshape(number, 2, shells, lines)
            for s in range(shells):
                at[self.place[:, t, s], every, :, s] += left[:, :, s]
            parameters = parameters + back[:, moving]
        turned = at[self.older + self.count + self.turned.T, every].swapaxes(0, 1)
        turned = turned.reshape(number, 2 * shells * self.turned.shape[1], lines)
        return Passed(through, parameters, at, np.concatenate([out[:, :size], later, turned], axis=1))
