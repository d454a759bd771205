# %% [markdown]
# # 2. Fit your loops
# Six recordings of an invented actuator, as they would come from a bench: several settled periods, noise, 16-bit counts.
# One call fits the density, the eddy resistance, the damping and the resonance together.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import PowerNorm

jax.config.update("jax_enable_x64", True)
from fitting import fit
from fitting.check import prediction
from fitting.demo import SINES, concealed_actuator, record
from magjax.bench import load_bench

plt.rcParams["font.size"] = 11

# %%
bench = load_bench("aa-050h")
true = concealed_actuator(bench)
rng = np.random.default_rng(0)
recordings = [record(true, f, A, b, rng, f"{f} Hz") for f, A, b in SINES]
fig, ax = plt.subplots(figsize=(8, 4.5), layout="constrained")
for r, colour in zip(recordings, plt.cm.viridis(np.linspace(0, 0.9, 6)), strict=True):
    ax.plot(r.channels["current"][:1000], r.channels["displacement"][:1000] * 1e6, color=colour, label=r.name)
ax.set(xlabel="current / A", ylabel="displacement / µm", title="the first period of each recording")
fig.legend(loc="outside right center")
plt.show()

# %% [markdown]
# ## The fit
# The recordings are reduced to harmonics; what lies between the harmonics is the noise. chi2/N near one means that nothing
# is left to explain, and only then do the error bars hold.

# %%
result = fit(recordings, bench, refine=False)
print(result)

# %% [markdown]
# ## Against the truth
# The constants that were put in: 62 ohm, 0.81, 405 Hz.

# %%
for name, truth in (("coil.R_eddy", 62.0), ("mechanics.xi", 0.81), ("mechanics.f0", 405.0)):
    e = result.estimate(name)
    print(f"{name:14s} {e.value:9.4f} +- {e.stderr:.4f}   true {truth:7.2f}   {(e.value - truth) / e.stderr:+.1f} standard errors")

# %% [markdown]
# ## The density that was found
# The mass of the relays over their two thresholds, beside the one that was put in (of another form, on a grid twice as fine). In
# the found one the first column and the last row hold relays that switch once and stay. Colours go with the root.

# %%
fig, axes = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained", sharey=True)
for ax, actuator, title in zip(axes, (true, result.actuator), ("put in", "found"), strict=True):
    found = actuator.hysteresis
    density = np.where(np.tri(found.cells), found.masses, np.nan) / np.diff(found.levels / 1e3)[0] ** 2
    image = ax.imshow(density, origin="lower", extent=(found.low / 1e3, found.high / 1e3) * 2, norm=PowerNorm(0.5, 0, 4000))
    ax.set(xlabel="lower threshold / (kA/m)", title=title, xlim=(-2, 27.5), ylim=(-2, 27.5))
axes[0].set_ylabel("upper threshold / (kA/m)")
fig.colorbar(image, label="mass / (A/m per (kA/m)²)")
plt.show()

# %% [markdown]
# ## Use it
# The fitted actuator foretells a drive that took no part in the fit: 70 Hz, between those of the fit. What is left of 23 um is
# hardly more than the noise.

# %%
fresh = record(true, 70, 0.6, 0.05, rng, "70 Hz")
predicted, measured, noise = prediction(result.actuator, fresh, bench)
fig, axes = plt.subplots(2, 1, figsize=(8, 6), layout="constrained", height_ratios=(3, 1))
axes[0].plot(fresh.channels["current"][:1000], measured[:1000] * 1e6, "C0", lw=5, alpha=0.4, label="measured")
axes[0].plot(fresh.channels["current"][:1000], predicted[:1000] * 1e6, "k--", lw=1.2, label="foretold")
axes[0].set(xlabel="current / A", ylabel="displacement / µm")
axes[0].legend(loc="lower right")
axes[1].plot(np.arange(1000) / 1000, (predicted - measured)[:1000] * 1e9, "k", lw=0.5)
axes[1].axhspan(-2e9 * noise, 2e9 * noise, color="C0", alpha=0.2)
axes[1].set(xlabel="part of the period (band: twice the noise)", ylabel="difference / nm")
print(f"difference {np.sqrt(np.mean((predicted - measured) ** 2)) * 1e9:.1f} nm rms, noise {noise * 1e9:.1f} nm rms")
plt.show()
