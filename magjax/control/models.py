"""The actuator as python-control systems: the whole as `nlsys`, its linear part as `ss`, loops by `interconnect`.

Signals carry their units in their names: current_A, displacement_m, u_A2_per_m2, error_um, control_Ms2.
"""

import numpy as np

from ..inverse.dynamic import PlainActuator
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


def actuator_system(plant: PlainActuator, T: float):
    """The whole actuator as a discrete `nlsys`: current held over T in, displacement out.

    The memory of the hysteresis is a staircase of any length and no vector: it is kept beside the two states of the rod
    and moves when the system is updated, so simulate forward in time (`input_output_response`) and call `reset` first.
    """
    import control

    actuator = HeldCurrent(plant)

    def update(t, x, u, params):
        actuator.displacement, actuator.speed = float(x[0]), float(x[1])
        actuator.hold(float(np.atleast_1d(u)[0]), T)
        return np.array([actuator.displacement, actuator.speed])

    def output(t, x, u, params):
        return np.array([x[0]])

    system = control.nlsys(update, output, inputs=["current_A"], outputs=["displacement_m"], states=["displacement_m", "speed_m_per_s"], dt=T, name="actuator")
    system.reset = actuator.reset
    system.actuator = actuator
    return system


def closed_loop(controller, extra_inputs: bool = True):
    """Fig. 12 by python-control's `interconnect`: reference_um and w0 in, error_um, control_Ms2 and z_um out."""
    import control

    problem = controller.problem
    dt = problem.T
    n, d_s, d_u = problem.factors()
    from .realize import state_space

    K = controller.to_control()
    delay = control.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], dt, inputs=["control_Ms2"], outputs=["u_Ms2"], name="inversion")
    plant = control.ss(*state_space(np.append(0.0, n), np.convolve(d_s, d_u)), dt, inputs=["u_tilde"], outputs=["y0_um"], name="rod")
    W = control.ss(*state_space(*problem.weight), dt, inputs=["u_tilde"], outputs=["z_um"], name="W0")
    two = control.ss([[0.0, 0.0], [1.0, 0.0]], [[1.0], [0.0]], [[0.0, 1.0]], [[0.0]], dt, inputs=["reference_um"], outputs=["late_um"], name="two_delays")
    add_noise = control.summing_junction(inputs=["u_Ms2", "noise_Ms2"], output="u_tilde", name="noise")
    add_v = control.summing_junction(inputs=["y0_um", "v_um"], output="y_um", name="uncertainty")
    error = control.summing_junction(inputs=["reference_um", "-y_um"], output="error_um", name="comparison")
    tracking = control.summing_junction(inputs=["late_um", "-y_um"], output="tracking_um", name="tracking")
    systems = [K, delay, plant, W, two, add_noise, add_v, error, tracking]
    return control.interconnect(systems, inputs=["reference_um", "noise_Ms2", "v_um"], outputs=["tracking_um", "u_Ms2", "z_um"], name="loop", dt=dt)


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
