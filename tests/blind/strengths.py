"""What may be concealed, and how strongly: mid-strength is about one per cent of the displacement's rms, or as stated."""

# name: (weak, mid, strong) in the units of the generator's own laws
VISIBLE = {
    "amplifier_lag": (2.5e-5, 6e-5, 1.5e-4),  # s; to first order a damping, hence larger
    "amplifier_clipping": (8.4, 8.0, 7.2),  # V
    "excess_loss": (3.0, 10.0, 35.0),  # A/m per root of T/s
    "field_diffusion": (0.15, 0.4, 1.0),  # share of a cylinder's true distribution
    "second_eddy_path": (0.007, 0.02, 0.07),
    "stress_feedback": (4e4, 1.3e5, 4.5e5),  # Pa
    "magnetic_aftereffect": (0.005, 0.015, 0.05),
    "rate_dependent_switching": (4.0, 13.0, 45.0),  # A/m per e-fold of the rate
    "quartic_magnetostriction": (0.015, 0.05, 0.17),
    "strain_hysteresis": (0.045, 0.15, 0.5),
    "second_mode": (0.003, 0.01, 0.035),
    "duffing_stiffness": (0.005, 0.015, 0.05),
    "delta_e": (0.01, 0.03, 0.1),
    "coulomb_friction": (0.001, 0.003, 0.01),  # of the full stroke
    "structural_damping": (0.004, 0.012, 0.04),
    "backlash": (4e-8, 1.3e-7, 4.5e-7),  # m
    "creep": (0.003, 0.01, 0.035),  # a decade
    "thermal_drift": (3e-7, 1e-6, 3.5e-6),  # m at full heat
    "sensor_lag": (2.5e-5, 6e-5, 1.5e-4),  # s
    "transport_delay": (2.5e-5, 6e-5, 1.5e-4),  # s
    "sensor_nonlinearity": (0.04, 0.12, 0.4),
    "inductive_crosstalk": (1.5e-10, 4e-10, 1.4e-9),  # m s/A
    "mains_hum": (3e-8, 1e-7, 3.5e-7),  # m
    "zero_drift": (1e-7, 3e-7, 1e-6),  # m over the record
}  # fmt: skip
HIDDEN = {
    "mean_field": (2e-4, 6e-4, 2e-3),
    "reversible_magnetization": (0.06, 0.2, 0.7),
    "linear_strain": (0.004, 0.012, 0.04),
}
OUTSIDE = {
    "field_kink": (0.0006, 0.002, 0.007),
    "wall_bowing": (0.05, 0.15, 0.5),
    "end_stop": (0.006, 0.02, 0.07),
    "cyclic_error": (4e-8, 1.2e-7, 4e-7),
    "subharmonic": (0.0015, 0.005, 0.017),
}  # fmt: skip
BLOCK_OF_OUTSIDE = {
    "field_kink": "magnetostriction",
    "wall_bowing": "coil",
    "end_stop": "mechanics",
    "cyclic_error": "sensor",
    "subharmonic": "mechanics",
}
FAULTS = ("clipped", "missing", "wrong_c0", "swapped_sign", "milliamperes", "unsettled")
LEVELS = ("weak", "mid", "strong")

# what recordings of current and displacement cannot tell apart, by the physics (to first order or altogether)
GROUPS = (
    ("quartic_magnetostriction", "linear_strain", "sensor_nonlinearity", "duffing_stiffness", "delta_e"),
    ("mean_field", "reversible_magnetization", "stress_feedback"),
    ("amplifier_lag", "sensor_lag", "transport_delay"),
    ("sensor_lag", "second_mode"),
    ("magnetic_aftereffect", "creep"),
    ("thermal_drift", "zero_drift", "creep"),
    ("field_diffusion", "second_eddy_path"),
    ("strain_hysteresis", "coulomb_friction", "backlash"),
)  # fmt: skip
