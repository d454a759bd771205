"""The actuator as python-control systems: the whole as `nlsys`, its linear part as `ss`, loops by `interconnect`.

Signals carry their units in their names: current_A, displacement_m, u_A2_per_m2, error_um, control_Ms2.
"""

import numpy as np

from ..errors import ConfigurationError
from ..inverse.dynamic import PlainActuator, magnetization_for
from ..inverse.events import HeldCurrent


def linear_part(plant: PlainActuator):
    """(5) as a continuous StateSpace: u = M^2 in (A/m)^2, displacement out in m."""
    import control

    w = 2 * np.pi * plant.f0
    gain = plant.l_rod * plant.lambda_s / plant.M_s**2
    A = np.array([[0.0, 1.0], [-w * w, -2 * plant.xi * w]])
    return control.ss(
        A, np.array([[0.0], [gain * w * w]]), np.array([[1.0, 0.0]]), np.zeros((1, 1)),
        inputs=["u_A2_per_m2"], outputs=["displacement_m"], states=["displacement_m", "speed_m_per_s"], name="rod",
    )  # fmt: skip


def actuator_system(plant: PlainActuator, T: float, current: float = 0.0):
    """The whole actuator as a discrete `nlsys`: current held over T in, displacement out, at rest at `current` (A) first.

    The memory of the hysteresis is a staircase of any length and no vector: it is kept beside the two states of the rod
    and moves when the system is updated, so simulate forward in time (`input_output_response`) and call `reset` first.
    """
    import control

    actuator = HeldCurrent(plant, current)

    def update(t, x, u, params):
        actuator.rod = [float(x[0]), float(x[1])]
        actuator.hold(float(np.atleast_1d(u)[0]), T)
        return np.array(actuator.rod)

    def output(t, x, u, params):
        return np.array([actuator.displacement - actuator.rod[0] + x[0]])

    system = control.nlsys(
        update,
        output,
        inputs=["current_A"],
        outputs=["displacement_m"],
        states=["displacement_m", "speed_m_per_s"],
        dt=T,
        name="actuator",
    )
    system.reset = actuator.reset
    system.actuator = actuator
    return system


def controller_system(controller, limit: float = np.inf, anti_windup: bool = True):
    """A realized controller with its saturation as an `nlsys`: error_um in, control_Ms2 out within +-limit (stable plants)."""
    import control

    if controller.direct is not None:
        raise ConfigurationError(
            "the controller of an unstable plant has no internal model to saturate; take Controller.to_control()"
        )
    (Aq, Bq, Cq, Dq), (Am, Bm, Cm, _) = controller.Q, controller.model
    n = len(Aq)

    def control_of(x, u):
        e = float(np.atleast_1d(u)[0]) + float(Cm[0] @ x[n:])
        asked = float(Cq[0] @ x[:n] + Dq[0, 0] * e)
        return e, asked, min(max(asked, -limit), limit)

    def update(t, x, u, params):
        e, asked, clipped = control_of(x, u)
        return np.concatenate([Aq @ x[:n] + Bq[:, 0] * e, Am @ x[n:] + Bm[:, 0] * (clipped if anti_windup else asked)])

    def output(t, x, u, params):
        return np.array([control_of(x, u)[2]])

    return control.nlsys(
        update, output, inputs=["error_um"], outputs=["control_Ms2"], states=n + len(Am), dt=controller.problem.T, name="K"
    )


def inverse_system(model: PlainActuator, T: float, middle: float = 0.5, limit: float = 2.0):
    """The inverse (7) as a discrete `nlsys`: control_Ms2 about `middle` in, current_A out within +-limit.

    Its memory is kept beside the vector of states, as in `actuator_system`.
    """
    import control

    operator = model.operator.copy()
    operator.solve(float(magnetization_for(model, middle)))

    def current(u, memory):
        H, M = memory.field, memory.magnetization
        H1 = memory.solve(float(magnetization_for(model, middle + float(np.atleast_1d(u)[0]))))
        I = (H1 + memory.magnetization - H - M) / (T * model.c1) + (H1 - model.H_bias) / model.c0
        return min(max(I, -limit), limit)

    def update(t, x, u, params):
        current(u, operator)
        return np.array([operator.field])

    def output(t, x, u, params):
        return np.array([current(u, operator.copy())])

    system = control.nlsys(
        update, output, inputs=["control_Ms2"], outputs=["current_A"], states=["field_A_per_m"], dt=T, name="inverse"
    )
    system.start = [operator.field]
    return system


def tracking_loop(controller, plant: PlainActuator, model: PlainActuator, limit: float = 0.5, anti_windup: bool = True):
    """Controller, inverse of the `model` and the hysteretic `plant` in a loop by python-control's `interconnect`.

    reference_um in; displacement_m, control_Ms2, current_A out. `start` of the result is its initial state (the middle of
    the range, at rest): `input_output_response(loop, t, reference, loop.start)`.
    """
    import control

    T = controller.problem.T
    inverse = inverse_system(model, T)
    current = (inverse.start[0] - model.H_bias) / model.c0
    actuator = actuator_system(plant, T, current)
    K = controller_system(controller, limit, anti_windup)
    comparison = control.ss(
        [], [], [], [[1.0, -1e6]], dt=T, inputs=["reference_um", "displacement_m"], outputs=["error_um"], name="comparison"
    )
    loop = control.interconnect(
        [comparison, K, inverse, actuator],
        inputs=["reference_um"],
        outputs=["displacement_m", "control_Ms2", "current_A"],
        name="tracking",
        dt=T,
    )
    loop.start = np.concatenate([np.zeros(K.nstates), inverse.start, actuator.actuator.rod])
    return loop


def closed_loop(controller):
    """Fig. 12 by python-control's `interconnect`: reference_um and w0 in, error_um, control_Ms2 and z_um out."""
    import control

    problem = controller.problem
    dt = problem.T
    n, d_s, d_u = problem.factors()
    from .realize import state_space

    K = controller.to_control()
    delay = control.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], dt, inputs=["control_Ms2"], outputs=["u_Ms2"], name="inversion")
    plant = control.ss(
        *state_space(np.append(0.0, n), np.convolve(d_s, d_u)), dt, inputs=["u_tilde"], outputs=["y0_um"], name="rod"
    )
    W = control.ss(*state_space(*problem.weight), dt, inputs=["u_tilde"], outputs=["z_um"], name="W0")
    two = control.ss(
        [[0.0, 0.0], [1.0, 0.0]],
        [[1.0], [0.0]],
        [[0.0, 1.0]],
        [[0.0]],
        dt,
        inputs=["reference_um"],
        outputs=["late_um"],
        name="two_delays",
    )
    add_noise = control.summing_junction(inputs=["u_Ms2", "noise_Ms2"], output="u_tilde", name="noise")
    add_v = control.summing_junction(inputs=["y0_um", "v_um"], output="y_um", name="uncertainty")
    error = control.summing_junction(inputs=["reference_um", "-y_um"], output="error_um", name="comparison")
    tracking = control.summing_junction(inputs=["late_um", "-y_um"], output="tracking_um", name="tracking")
    systems = [K, delay, plant, W, two, add_noise, add_v, error, tracking]
    return control.interconnect(
        systems, inputs=["reference_um", "noise_Ms2", "v_um"], outputs=["tracking_um", "u_Ms2", "z_um"], name="loop", dt=dt
    )


def rebuilt_norms(controller, count: int = 600) -> dict:
    """The five l1 norms from python-control's closed loop, for comparison with the design's."""
    loop, p = closed_loop(controller), controller.problem
    A, B, C, D = (np.asarray(m) for m in (loop.A, loop.B, loop.C, loop.D))
    sums = np.abs(D).astype(float)
    x = B.copy()
    for _ in range(count):
        sums = sums + np.abs(C @ x)
        x = A @ x
    return {
        "error_r": p.r_bar * sums[0, 0], "error_w": p.w_bar * sums[0, 1], "control_r": p.r_bar * sums[1, 0],
        "control_w": p.w_bar * sums[1, 1], "robust": sums[2, 2],
    }  # fmt: skip
