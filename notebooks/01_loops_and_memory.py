# %% [markdown]
# # 1. Loops and memory
# A Preisach operator is a population of relays, each with two thresholds. It remembers the past of its input only through a
# staircase in the plane of thresholds: reversals go in, larger ones wipe out smaller ones.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

jax.config.update("jax_enable_x64", True)
from magjax.bench import load_bench
from magjax.preisach import Preisach, gaussian_lorentzian_masses
from magjax.simulate import simulate

# %% [markdown]
# ## The same field, two different magnetizations
# A decaying field draws nested loops. At the same field the branches differ: that is memory.

# %%
masses = gaussian_lorentzian_masses(60, -1000.0, 1000.0, 1.0, 0.0, 300.0, 150.0, 200.0)
operator = Preisach(masses, -1000.0, 1000.0)
steps = np.arange(2400)
field = 900 * np.exp(-steps / 900) * np.sin(2 * np.pi * steps / 400)
M = operator.magnetization(field, corners=24)
fig, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
axes[0].plot(field, lw=1)
axes[0].set(xlabel="sample", ylabel="field, A/m")
axes[1].plot(field, M, lw=1)
axes[1].set(xlabel="field, A/m", ylabel="magnetization, relative")

# %% [markdown]
# ## Relays, smeared
# A grid of point relays jumps and has no gradient. Spreading each mass over its cell gives a continuous operator with
# exact gradients; a relay of finite slope lies between.

# %%
coarse = Preisach(gaussian_lorentzian_masses(8, -1000.0, 1000.0, 1.0, 0.0, 300.0, 150.0, 200.0), -1000.0, 1000.0)
up = np.linspace(-1000, 1000, 600)
for surrogate in ("hard", "kp", "uniform"):
    plt.plot(up, coarse.magnetization(up, surrogate=surrogate), label=surrogate)
plt.gcf().set_size_inches(5, 3.2)
plt.xlabel("field, A/m")
plt.legend()

# %% [markdown]
# ## Rate
# Behind a coil with eddy currents and a mechanical mode, the loop of displacement against current turns with frequency.

# %%
actuator = load_bench("aa-050h").actuator()
current = 0.1 + 0.8 * np.sin(2 * np.pi * np.arange(500) / 500)
fig, ax = plt.subplots(figsize=(5, 3.4), layout="constrained")
for f in (10, 50, 100, 200, 300):
    signals = simulate(actuator, current, 1 / (500 * f), periodic=True)
    ax.plot(current, np.asarray(signals.displacement) * 1e6, label=f"{f} Hz")
ax.set(xlabel="current, A", ylabel="displacement, um")
ax.legend(fontsize=8)

# %% [markdown]
# ## Gradients of anything
# The chain is differentiable: here the sensitivity of the largest displacement to the eddy resistance.

# %%
from magjax.simulate import run_chain

largest = lambda R: run_chain(actuator.replace({"coil.R_eddy": R}), jax.numpy.asarray(current), 1e-5, 3, 4).displacement.max()
print("d(largest displacement)/d(R_eddy) =", float(jax.grad(largest)(70.0)), "m per ohm")
