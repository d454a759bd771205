"""The derivative of the reading's lines by rows: what each line asks of every step of the march.

Of a fit's unknowns there are hundreds or thousands, of a recording's lines 81. So the lines are led back: through the blocks behind the
hysteresis by reverse-mode derivatives, through the march by a recursion over the small derivatives of its steps (`Steps`), to
what is added to M there. A hat's share is then a product with its Everett values, that of a candidate effect one with what it
would add; neither asks for a program of its own.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from magjax.chain import Timeline
from magjax.chain.march import Steps, linearized
from magjax.chain.shells import distribution
from magjax.effects.base import AbstractEffect
from magjax.programs import kept
from magjax.simulate import driven_current, finish_chain

from .periods import Backward
from .starts import unreached_row


class Marched(eqx.Module):
    """Marches to first order, of all recordings of a predictor with one grid: (recordings, ...) each.

    `field`, `magnetization`, `spread`: (samples,), of the last period, `current`: A, in the coil; `drive`: (2, samples, parameters), of applied field and current by
    the parameters, the last of which is the sum of the masses, relative, as effects read it; `gain`: of the applied field by the
    current; `unreached`: (2,), of M by the highest and the lowest relay field of the last period.
    """

    steps: Steps
    field: jax.Array
    magnetization: jax.Array
    spread: jax.Array
    current: jax.Array
    drive: jax.Array
    gain: jax.Array
    unreached: jax.Array


@kept
def marched_steps(template, names, point, predictor) -> Marched:
    """`Marched` at a `passes.Point`."""

    def one(drive, dt, level):
        line, count = Timeline(dt, drive.shape[0], True), drive.shape[0]

        def made(given):
            # the last: of the masses, whose sum some effects read; the table stays
            masses = None if point.masses is None else given[-1] * point.masses
            own = dataclasses.replace(point, masses=masses, offset=point.offset + level, parameters=given[:-1], levels=None)
            return own.actuator(template, names)

        def driven(parameters):
            actuator = made(parameters)
            current = driven_current(actuator, drive, line)
            return jnp.stack([actuator.coil.applied_field(current), current])

        parameters = jnp.append(point.parameters, 1.0)
        actuator, (applied, current) = made(parameters), driven(parameters)
        whole = (jnp.append(jnp.tile(x, *predictor.periods), x[:1]) for x in (applied, current))
        steps = linearized(made, parameters, *whole, dt, predictor.corners, actuator.coil.scheme, count, predictor.times)
        relay = steps.relay_field[-count:].mean(axis=1)
        ends = jnp.max(relay), jnp.min(relay)
        H, M, spread = (x[-count - 1 : -1] for x in (steps.field, steps.magnetization, steps.spread))
        return Marched(
            steps, H, M + actuator.hysteresis.unreached(*ends), spread, current, jax.jacfwd(driven)(parameters),
            jax.jacfwd(actuator.coil.applied_field)(current[0]), jnp.stack(jax.jacfwd(actuator.hysteresis.unreached, (0, 1))(*ends)),
        )  # fmt: skip

    return jax.vmap(one)(predictor.drives[0], predictor.steps[0], point.levels)


class _Added(AbstractEffect):
    """Signals added behind the hysteresis, (time,): to the free displacement, the displacement, the reading."""

    free: jax.Array
    moved: jax.Array
    read: jax.Array

    def strain(self, free_displacement, magnetization, field, line, actuator):
        return free_displacement + self.free

    def displacement(self, displacement, free_displacement, signals, line, actuator):
        return displacement + self.moved

    def reading(self, reading, signals, line, actuator):
        return reading + self.read


SIGNALS = ("field", "magnetization", "spread", "current", "free displacement", "displacement", "reading")


@kept
def read_rows(template, names, parameters, predictor, marched):
    """The lines of all recordings of a predictor with one grid by the signals `SIGNALS`, (recordings, lines, 7, samples), and by the
    parameters, (recordings, lines, parameters). Lines: the real parts of 0..harmonics, the imaginary ones of 1..harmonics.

    `marched`: field, magnetization and its spread, (recordings, samples) each.
    """
    count = predictor.harmonics + 1

    def one(drive, dt, *fields):
        line, zero = Timeline(dt, drive.shape[0], True), jnp.zeros(())

        def lines(changes, parameters):
            actuator = template.replace(dict(zip(names, parameters, strict=True)))
            changed = dataclasses.replace(actuator, effects=(*actuator.effects, _Added(*changes[4:])))
            current = driven_current(actuator, drive, line) + changes[3]
            moved = (x + y for x, y in zip(fields, changes, strict=False))
            s = finish_chain(changed, line, drive, current, *moved, fields[0], zero, zero)
            found = jnp.fft.rfft(s.reading)[:count] / drive.shape[0]
            return jnp.concatenate([found.real, found.imag[1:]])

        _, pull = jax.vjp(lines, jnp.zeros((len(SIGNALS), *drive.shape)), parameters)
        return jax.vmap(pull)(jnp.eye(2 * count - 1))

    return jax.vmap(one)(predictor.drives[0], predictor.steps[0], *marched)


@dataclasses.dataclass(frozen=True)
class Rows:
    """What every line of some recordings, (recordings, lines) of each array, asks of their marches and of what is read.

    `marched`: of the same recordings, in NumPy, without the slopes of its steps; `signals`: (7, samples), see `SIGNALS`; `read`:
    (parameters,), of those behind the march; `stored`: the samples of what is stored of the march at the ends of its steps, as all that follow
    (`ends_taken`); `own`: (steps, shells), of what is added to M of the relays, and stays; `known`: (older places,), the same of the bottom
    of the plane, with all that rests on it, of the maxima and of the minima of the memory; `drive`: (samples, 2), of applied field and
    current on the way into the march; `disturbed`: (steps, 3), of what is added to the steps, see `magnetize`; `moving`:
    (parameters,), of those of the march; `mean`: (), of what is added to M of all samples.
    """

    marched: Marched
    signals: np.ndarray
    read: np.ndarray
    stored: np.ndarray
    own: np.ndarray
    known: np.ndarray
    drive: np.ndarray
    disturbed: np.ndarray
    moving: np.ndarray
    mean: np.ndarray

    def by_density(self, basis, rest) -> np.ndarray:
        """The lines by the unknowns of a density at a total mass of 1, the lowest M held: (recordings, lines, unknowns); `rest`: see `Preisach`."""
        steps, found = self.marched.steps, []
        for r, (maxima, minima) in enumerate(steps.corners):
            corners, relay = len(maxima), steps.relay_field[r]
            fixed, field, rising = (x.ravel() for x in (steps.threshold[r], relay[self.stored], steps.rising[r]))
            alpha = np.concatenate([np.where(rising, field, fixed), maxima, maxima])
            beta = np.concatenate([np.where(rising, fixed, field), [basis.low], minima[:-1], minima])
            sign = np.concatenate([np.where(rising, 2.0, -2.0), np.full(corners, 2.0), np.full(corners, -2.0)])
            asked = np.concatenate([self.own[r].reshape(len(self.own[r]), -1), self.known[r, :, 1:]], axis=1)
            last = relay[-self.signals.shape[3] :].mean(axis=1)
            never = unreached_row(basis, last.max(), last.min(), rest)
            found.append((asked * sign) @ basis.everett(alpha, beta) + self.mean[r][:, None] * never)
        return np.stack(found)

    def by_moving(self) -> np.ndarray:
        """The lines by the parameters of the march and of what is before it, (recordings, lines, parameters), the last of them the
        sum of the masses as effects read it."""
        return self.moving + np.einsum("rlnk,rknp->rlp", self.drive, self.marched.drive, optimize=True)

    def of_steps(self, *added) -> np.ndarray:
        """First-order change of the lines by what is added to every step of `path`, 3 of (columns, recordings, steps + 1) as `magnetize`
        has them, or None: (columns, recordings, lines)."""
        return sum(np.einsum("rlt,crt->crl", self.disturbed[..., k], x[:, :, self.stored], optimize=True) for k, x in enumerate(added) if x is not None)

    def path(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Relay field and magnetization, A/m, and current, A, over the march, of a long one its first and last periods: (recordings, steps + 1)
        each; of a rod in shells their mean."""
        steps, current = self.marched.steps, self.marched.current
        periods = (steps.magnetization.shape[1] - 1) // current.shape[1]
        return steps.relay_field @ distribution(steps.relay_field.shape[2])[1], steps.magnetization, np.concatenate([np.tile(current, periods), current[:, :1]], axis=1)

    def of_drive(self, change) -> np.ndarray:
        """The same by a change of the current, A, (columns, recordings, samples)."""
        asked = self.drive[..., 0] * self.marched.gain[:, None, None] + self.drive[..., 1] + self.signals[:, :, 3]
        return np.einsum("rln,crn->crl", asked, change, optimize=True)

    def of_signals(self, *late) -> np.ndarray:
        """The same by changes of free displacement, displacement and reading, (columns, recordings, samples), or None."""
        return sum(np.einsum("rln,crn->crl", self.signals[:, :, 4 + k], x, optimize=True) for k, x in enumerate(late) if x is not None)


def as_lines(rows) -> np.ndarray:
    """Complex lines 0..harmonics, (..., harmonics + 1), of real rows (..., lines)."""
    count = (rows.shape[-1] + 1) // 2
    lines = rows[..., :count].astype(complex)
    lines[..., 1:] += 1j * rows[..., count:]
    return lines


@np.errstate(over="ignore", invalid="ignore")  # of a trial that has left all reason; the solver sees that its numbers are none
def rows_of(marched: Marched, signals: np.ndarray, read: np.ndarray) -> Rows:
    """Led back through the marches, from the last step to the first; arguments as in `Rows`, in NumPy.

    Where the last period stands for others, what it leaves for the one before is led through it again: by the few numbers that go
    from period to period, X -> A X, of which the sum over all of them is led through the steps at once.
    """
    back = Backward(marched, signals.shape[3])
    asked = back.asked(signals)
    passed = back.led(asked)
    if not back.before:
        return _gathered(back, [passed], signals, read)
    A, left = back.led(back.each()).left, passed.left
    every = left
    for _ in range(back.before - 1):
        left = A @ left
        every = every + left
    last = back.led(back.entering(every, asked))
    first = back.led(back.entering(A @ left, back.nothing(signals.shape[1]), last.at), first=True)
    return _gathered(back, [first, last], signals, read)


def _gathered(back: Backward, passed, signals, read) -> Rows:
    """What was led through the periods, the first one first, as `Rows`."""
    steps, number, shells, size, older = back.marched.steps, back.number, back.shells, back.size, back.older
    at, end = passed[0].at[:older].copy(), passed[0].left
    out = end[:, :size].copy()
    out[:, back.marks] += end[:, size : size + back.marks.stop - back.marks.start]
    first = steps.rest.swapaxes(1, 2) @ out
    at[older - 1, :, 1] += first[:, :shells]
    known = at.sum(axis=3)  # shells have the same before the first step
    begin = first[:, shells : shells + 2]
    begin[:, 0] += np.einsum("prkl,rpk->rl", known, steps.moved)
    known = np.moveaxis(known[:, :, 1], 0, 2)
    number_of = (older - 2) // 2
    known[..., 2 * number_of] += known[..., older - 1]  # the last minimum is where the memory stands
    for k in range(number_of - 1, -1, -1):  # a minimum is reached from its maximum, that from the minimum before it
        known[..., 1 + k] += known[..., 1 + number_of + k]
        known[..., number_of + k if k else 0] += known[..., 1 + k]
    through = np.concatenate([p.through for p in passed]) if len(passed) > 1 else passed[0].through
    through = through.transpose(1, 3, 0, 2)  # (recordings, lines, steps, ...)
    drive = through[:, :, :-1, shells : shells + 2]
    drive = np.concatenate([begin.swapaxes(1, 2)[:, :, None], drive], axis=2)
    drive = drive.reshape(number, signals.shape[1], -1, back.samples, 2).sum(axis=2)
    drive[:, :, 0] += through[:, :, -1, shells : shells + 2]
    own, disturbed = through[..., :shells], through[..., shells + 2 :]
    moving = (sum(p.parameters for p in passed) + first[:, shells + 2 :]).swapaxes(1, 2)
    mean = signals[:, :, 1].sum(axis=-1)
    marched = dataclasses.replace(back.marched, steps=dataclasses.replace(steps, slopes=None))  # the large part of it has served
    return Rows(marched, signals, read, back.stored, own, known[..., : older - 1], drive, disturbed, moving, mean)
