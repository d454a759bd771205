# %% [markdown]
# # 2. Fit your loops
# Six recordings of an invented actuator, as they would come from a bench: several settled periods, noise, 16-bit counts.
# One call fits the density, the eddy resistance, the damping and the resonance together.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

jax.config.update("jax_enable_x64", True)
from fitting import fit
from fitting.demo import SINES, concealed_actuator, record
from magjax.bench import load_bench

# %%
bench = load_bench("aa-050h")
true = concealed_actuator(bench)
rng = np.random.default_rng(0)
recordings = [record(true, f, A, b, rng, f"{f} Hz") for f, A, b in SINES]
print(len(recordings), "recordings of", len(recordings[0].time), "samples")

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
# Rows are upper thresholds, columns lower ones. The first column and the last row hold relays that switch once and stay.

# %%
masses = np.asarray(result.actuator.hysteresis.masses)
plt.imshow(np.where(masses > 0, masses, np.nan), origin="lower", cmap="viridis", vmax=np.quantile(masses[masses > 0], 0.98))
plt.xlabel("column (lower threshold)")
plt.ylabel("row (upper threshold)")
plt.colorbar(label="mass, A/m")

# %% [markdown]
# ## Use it
# The fitted actuator simulates any other drive.

# %%
from magjax.simulate import simulate

current = 0.1 + 0.4 * np.sin(2 * np.pi * np.arange(600) / 600) + 0.3 * np.sin(6 * np.pi * np.arange(600) / 600)
for actuator, style in ((true, "k-"), (result.actuator, "r--")):
    plt.plot(current, np.asarray(simulate(actuator, current, 1 / (600 * 80), periodic=True).displacement) * 1e6, style, lw=1)
plt.xlabel("current, A")
plt.ylabel("displacement, um (true solid, fitted dashed)")
