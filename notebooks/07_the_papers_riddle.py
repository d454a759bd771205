# %% [markdown]
# # 7. The paper's riddle
# Tan and Baras give their actuator R_eddy = 70 ohm, f0 = 392 Hz and xi = 0.78. A solid rod of its size should have
# 8 pi rho N_m c0 = 290 ohm (rho = 0.58 uohm m), a bare rod rings near 9 kHz, and a damping of 0.78 is less like a rod than
# like a filter in a sensor's electronics. Nobody can tell without their recordings. But an invented bench can show that a
# quite ordinary actuator behind ordinary instruments comes out with constants just as strange, and what settles it.

# %%
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small dense solves: more threads only wait for each other
import matplotlib.pyplot as plt
import numpy as np

from fitting.demo import SINES, concealed_actuator
from fitting.diagnose import diagnose
from fitting.fit import fit
from fitting.instruments import known_instruments, line_gains, mode_as_filter
from fitting.setup import Choices
from magjax.bench import load_bench
from magjax.cli.runtime import prepare_jax
from magjax.effects import AmplifierLag, SensorLag
from magjax.recording import Recording
from magjax.simulate import simulate

prepare_jax()
QUICK = "MAGJAX_QUICK" in os.environ  # the fits without the diagnoses
bench = load_bench("aa-050h")
choices = Choices(rest="negative", fine=250)  # this bench starts saturated; "auto" would try other pasts, too

# %% [markdown]
# ## The bench
# R_eddy = 290 ohm, f0 = 2 kHz, xi = 0.1; a Butterworth filter of 400 Hz in the sensor and an amplifier of 90 us. Simulated with
# four times the fit's step and another density; 41 nm of noise. (`python -m tests.studies.riddle` tells the same story on a bench
# that shares no code with magjax.)

# %%
truth = {"coil.R_eddy": 290.0, "mechanics.f0": 2000.0, "mechanics.xi": 0.1}
tau, order2 = mode_as_filter(400.0, np.sqrt(0.5))
true = concealed_actuator(bench).replace(truth).with_effect(SensorLag(tau, order2)).with_effect(AmplifierLag(90e-6))
rng = np.random.default_rng(7)


def run(f, A, offset, shunt):
    command = offset + A * np.sin(2 * np.pi * np.arange(2000) / 2000)
    signals = simulate(true, command, 1 / (2000 * f), periodic=True)
    command, current, y = (np.tile(np.asarray(x)[::2], 4) for x in (command, signals.current, signals.reading))
    channels = {"displacement": y + 41e-9 * rng.standard_normal(4000)}
    channels |= {"command": command, "current": current + 2e-4 * rng.standard_normal(4000)} if shunt else {"current": command}
    return Recording(np.arange(4000) / (1000 * f), channels, {}, {}, f"{f} Hz")


plain = [run(*drive, shunt=False) for drive in SINES]
check = [run(65, 0.6, 0.0, shunt=False)]

# %% [markdown]
# ## The plain fit
# Command in, displacement out. The loops are met to a hundredth of their width, and the constants look like the paper's.

# %%
base = fit(plain, bench, choices=choices, refine=False)
for name, value in truth.items():
    paper = {"coil.R_eddy": 70.0, "mechanics.f0": 392.0, "mechanics.xi": 0.7783}[name]
    print(f"{name:14s} true {value:6g}   plain fit {base.estimate(name).value:8.4g}   the paper {paper:g}")
print(f"chi2/N = {base.chi2_per_sample:.0f}: the misfit is {np.sqrt(base.chi2_per_sample):.0f} times the noise of a harmonic")

# %%
from fitting.check import prediction  # noqa: E402

fig, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
for k, r in enumerate(plain[::2]):
    predicted, measured, _ = prediction(base.actuator, r, bench)
    one = slice(0, 1000)
    axes[0].plot(r.channels["current"][one], measured[one] * 1e6, color=f"C{k}", lw=3, alpha=0.4, label=r.name)
    axes[0].plot(r.channels["current"][one], predicted[one] * 1e6, color=f"C{k}", lw=0.8)
    axes[1].plot(np.arange(1000) / 1000, (measured - predicted)[one] * 1e9, color=f"C{k}", lw=0.7)
axes[0].set(xlabel="command, A", ylabel="reading, um", title="measured (wide), plain fit (thin)")
axes[0].legend(fontsize=8)
axes[1].set(xlabel="phase, periods", ylabel="nm", title="what is left; the noise is 41 nm")

# %% [markdown]
# ## The diagnosis of command and displacement
# Linear filters commute. A filter of second order in the sensor behind a resonance of the rod reads the same as the two exchanged, so
# these channels cannot say which constants are the rod's. An honest diagnosis says just that, and what to record.

# %%
if not QUICK:
    found = diagnose(plain, bench, check=check, choices=choices)
    print(found)
    print("\nnext:", found.next_experiment and found.next_experiment["text"])

# %%
f = np.geomspace(20, 5000, 400)
s = 2j * np.pi * f
mode = lambda f0, xi: 1 / (1 + 2 * xi * s / (2 * np.pi * f0) + (s / (2 * np.pi * f0)) ** 2)
fig, ax = plt.subplots(figsize=(7, 3.2), layout="constrained")
ax.loglog(f, abs(mode(2000, 0.1)), "C0", label="rod: 2 kHz, 0.1")
ax.loglog(f, abs(mode(400, np.sqrt(0.5))), "C1", label="sensor: 400 Hz, 0.71")
ax.loglog(f, abs(mode(2000, 0.1) * mode(400, np.sqrt(0.5))), "k", label="product: all that the reading shows")
ax.axvspan(10, 300, color="0.93")
ax.set(xlabel="Hz (grey: drives)", ylabel="gain", ylim=(1e-3, 10), xlim=(20, 5000), title="which factor is whose?")
ax.legend(fontsize=8)

# %% [markdown]
# ## The recordings that were asked for
# The same drives with a shunt in the coil's circuit, and the sensor on a shaker beside a reference. Each instrument is judged by itself;
# no model of the rod takes part.

# %%
shunted = [run(*drive, shunt=True) for drive in SINES]
shunted_check = [run(65, 0.6, 0.0, shunt=True)]


def shake(f):
    phase = 2 * np.pi * np.arange(4000) / 1000
    gain = 1 / (1 + 2j * np.pi * f * tau + order2 * (2j * np.pi * f * tau) ** 2)
    y = 2e-5 * np.imag(gain * np.exp(1j * phase)) + 41e-9 * rng.standard_normal(4000)
    reference = 2e-5 * np.sin(phase) + 5e-9 * rng.standard_normal(4000)
    return Recording(phase / (2 * np.pi * f), {"reference": reference, "displacement": y}, {}, {}, f"shaker {f} Hz")


calibration = [shake(f) for f in (20, 60, 150, 300, 500, 800, 1200)]
known = known_instruments(shunted, calibration, bench)
print(*(i.text for i in known), sep="\n")
fig, axes = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
for ax, rows, drive, output, law in (
    (axes[0], shunted, "command", "current", lambda s: 1 / (1 + s * known[0].parameters["tau"][0])),
    (axes[1], calibration, "reference", "displacement", lambda s: 1 / (1 + s * tau + order2 * (s * tau) ** 2)),
):
    w, gain, _ = line_gains(rows, drive, output)
    grid = np.geomspace(w.min(), w.max(), 200)
    ax.semilogx(grid / 2 / np.pi, np.degrees(np.angle(law(1j * grid))), "0.6")
    ax.semilogx(w / 2 / np.pi, np.degrees(np.angle(gain)), "o")
    ax.set(xlabel="Hz", ylabel="phase, degrees", title=f"{output} over {drive}")

# %% [markdown]
# ## With them
# The measured current drives the coil, the sensor's filter is part of the model, and the rod is what remains.

# %%
if QUICK:
    priors = {f"effects.sensor_lag.{k}": e for k, (_, e) in known[1].parameters.items()}
    print(known[1].effect().name, priors)
else:
    settled = diagnose(shunted, bench, check=shunted_check, calibration=calibration, choices=choices)
    print(settled)

# %%
if not QUICK:
    fig, axes = plt.subplots(1, 3, figsize=(9, 2.6), layout="constrained")
    for ax, (name, value) in zip(axes, truth.items(), strict=True):
        for k, result in enumerate((base, settled.repaired)):
            e = result.estimate(name)
            ax.errorbar([k], [e.value], [2 * e.stderr], fmt="s" if k == 0 else "o", capsize=4)
        ax.axhline(value, color="0.7")
        ax.set(
            title=f"{name}, {e.unit}" if e.unit != "1" else name,
            xticks=[0, 1],
            xticklabels=["plain", "with instruments"],
            xlim=(-0.5, 1.5),
        )
        ax.set_ylim(0, None)
