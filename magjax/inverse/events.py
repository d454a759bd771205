"""T&B (4) under a held current, exactly: event by event, no step size (and the rod behind it).

Between two events (a level of the plane, a corner of the memory, the equilibrium) the branch is a quadratic of the
field. With x the way from the segment's start, x_eq the way to the equilibrium c0 I + H_bias and k = c1/c0,
    (1 + a1 + 2 a2 x) dx/dt = k (x_eq - x)
and with u = -log(1 - x/x_eq), B = 2 a2 x_eq this integrates to (1 + a1) u + B (u + exp(-u) - 1) = k t: the time of
every event is in closed form, and the last x takes a monotone Newton iteration from u0 = k t/(1 + a1).
"""

import math

from ..errors import ConfigurationError
from .dynamic import PlainActuator, with_second_mode

PLANT_EFFECTS = ("amplifier_lag", "quartic_magnetostriction", "second_mode")


class HeldCurrent:
    """An actuator driven by a current that is held between calls. State: `field`, the memory, `rod` = [y, dy/dt].

    `events`: how many the last call crossed. Of the effects an amplifier's lag (piecewise: its mean over each of the
    `pieces`), a quartic law and a second mode are simulated; raises `ConfigurationError` for others.
    """

    def __init__(self, plant: PlainActuator, current: float = 0.0, pieces: int = 8):
        unknown = [e for e in plant.effects if e not in PLANT_EFFECTS]
        if unknown:
            raise ConfigurationError(f"{', '.join(unknown)}: not simulated event by event; take magjax.simulate for this plant")
        self.plant, self.pieces, self._start = plant, pieces, float(current)
        self.reset()

    def reset(self):
        """Equilibrium at the starting current."""
        self.operator = self.plant.operator.copy()
        self.field = self.plant.c0 * self._start + self.plant.H_bias
        self.operator.apply(self.field)
        self.amplifier = [self._start, 0.0]  # its current and the rate of it
        self.rod, self.second, self.events = [self._free(), 0.0], [self._free(), 0.0], 0

    @property
    def displacement(self) -> float:
        """Displacement, m."""
        return with_second_mode(self.plant, self.rod, self.second)

    @property
    def speed(self) -> float:
        """Speed of the first mode, m/s."""
        return self.rod[1]

    @property
    def magnetization(self) -> float:
        """M, A/m."""
        return self.operator.magnetization

    def _free(self):
        p = self.plant
        square = (self.magnetization / p.M_s) ** 2
        b = p.effects.get("quartic_magnetostriction", {}).get("b", 0.0)
        return p.l_rod * p.lambda_s * (square + b * (square * square - square))

    def hold(self, current: float, duration: float) -> float:
        """Hold `current` (A) for `duration` (s): field, memory and rod move on; returns the displacement, m.

        The hysteresis is exact; the rod is led by its force at `pieces` points, straight between them (the exact
        transition of a damped oscillator).
        """
        piece = duration / self.pieces
        before = self._free()
        mode = self.plant.effects.get("second_mode")
        for _ in range(self.pieces):
            self.advance(self._delivered(current, piece), piece)
            after = self._free()
            self.rod = oscillate(self.rod, before, after, piece, self.plant.f0, self.plant.xi)
            if mode is not None:
                self.second = oscillate(self.second, before, after, piece, mode["f2"], mode["xi2"])
            before = after
        return self.displacement

    def _delivered(self, command, piece):
        """Mean current over a piece behind the amplifier's lag, from the integral of its equation."""
        lag = self.plant.effects.get("amplifier_lag", {})
        tau, order2 = lag.get("tau", 0.0), lag.get("order2", 0.0)
        if tau <= 0:
            self.amplifier = [command, 0.0]
            return command
        before, rate = self.amplifier
        if order2 < 1e-3:  # one pole, a thousand times slower than the other
            self.amplifier = [before - (command - before) * math.expm1(-piece / tau), 0.0]
            order2 = 0.0
        else:
            root = math.sqrt(order2)
            self.amplifier = oscillate(self.amplifier, command, command, piece, 1 / (2 * math.pi * tau * root), 0.5 / root)
        now, later = self.amplifier
        return command - (tau * (now - before) + order2 * tau * tau * (later - rate)) / piece

    def advance(self, current: float, duration: float) -> float:
        """Field and memory alone under a held current; returns the field, A/m."""
        operator, plant = self.operator, self.plant
        if not (math.isfinite(current) and 0 <= duration < math.inf):
            raise ConfigurationError(f"a current of {current} A held for {duration} s; give numbers, the time not negative")
        k = plant.c1 / plant.c0
        goal = plant.c0 * current + plant.H_bias
        left, self.events = k * duration, 0
        while left > 0 and self.field != goal:
            rising = goal > self.field
            outside = self.field >= operator.high if rising else self.field <= operator.low
            beyond = self.field < operator.low if rising else self.field > operator.high
            if outside or beyond:  # no relay moves: a plain exponential
                edge = (operator.low if rising else operator.high) if beyond else goal
                stop = min(goal, edge) if rising else max(goal, edge)
                left = self._segment(goal, stop, 0.0, 0.0, left, None)
                continue
            base, m_base = operator._branch_base(rising)
            limit = operator._next_corner(rising)
            cell = operator._cell(self.field, rising)
            edge = operator.levels[cell + 1] if rising else operator.levels[cell]
            stop = min(edge, limit) if rising else max(edge, limit)
            a1, a2 = self._slopes(cell, base, rising)
            left = self._segment(goal, stop, a1, a2, left, (rising, base, m_base))
        return self.field

    def _slopes(self, cell, base, rising):
        """dM/dH = a1 + 2 a2 x along the way from the present field."""
        operator = self.operator
        _, c1, c2 = operator._quadratic(cell, base, rising)
        z = (self.field - operator.levels[cell]) / operator.step
        slope = 2 * (c1 + 2 * c2 * z) / operator.step
        return max(slope if rising else -slope, 0.0), 2 * c2 / operator.step**2

    def _segment(self, goal, stop, a1, a2, left, branch):
        """Go to `stop` or as far as `left` = k t allows; returns what is left of k t."""
        self.events += 1
        x_eq = abs(goal - self.field)
        way = abs(stop - self.field)
        B = 2 * a2 * x_eq

        def needed(u):
            return (1 + a1) * u + B * (u + math.expm1(-u))

        if way < x_eq:
            u_stop = -math.log1p(-way / x_eq)
            cost = needed(u_stop)
            if cost <= left:
                self._move(stop, branch)
                return left - cost
        u = left / (1 + a1)  # needed is convex and steeper: Newton falls monotonically
        for _ in range(60):
            change = (needed(u) - left) / (1 + a1 - B * math.expm1(-u))
            u -= change
            if abs(change) <= 1e-16 * (1 + u):
                break
        x = -x_eq * math.expm1(-u)
        v = self.field + x if goal > self.field else self.field - x
        if way < x_eq:
            v = min(v, stop) if goal > self.field else max(v, stop)
        self._move(v, branch)
        return 0.0

    def _move(self, field, branch):
        if branch is not None and field != self.field:
            self.operator._advance(field, *branch)
        self.field = field


def oscillate(state, before: float, after: float, h: float, f0: float, xi: float) -> list[float]:
    """Exact transition over h (s) of y'' + 2 xi w y' + w^2 y = w^2 u from state = [y, y'], u straight from `before` to `after`."""
    w = 2 * math.pi * f0
    slope = (after - before) / h
    # less the particular solution u(t) - 2 xi slope / w, a straight line
    y0, v0 = state[0] - before + 2 * xi * slope / w, state[1] - slope
    root = w * math.sqrt(abs(1 - xi * xi))
    decay = math.exp(-xi * w * h)
    if xi < 1:
        c, s = math.cos(root * h), (math.sin(root * h) / root)
    elif xi > 1:
        c, s = math.cosh(root * h), (math.sinh(root * h) / root)
    else:
        c, s = 1.0, h
    y = decay * (y0 * c + (v0 + xi * w * y0) * s)
    v = decay * (v0 * c - (w * w * y0 + xi * w * v0) * s)
    return [y + after - 2 * xi * slope / w, v + slope]
