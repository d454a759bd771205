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
from magjax.preisach.relays import relay_states
from magjax.simulate import run_chain, simulate

plt.rcParams["font.size"] = 11

# %% [markdown]
# ## The same field, many magnetizations
# A decaying field draws nested loops. On the dotted line the field is the same each time and the magnetization is not: that is
# memory.

# %%
masses = gaussian_lorentzian_masses(60, -1000.0, 1000.0, 1.0, 0.0, 300.0, 150.0, 200.0)
operator = Preisach(masses, -1000.0, 1000.0)
steps = np.arange(1501)
field = 900 * np.exp(-steps / 900) * np.sin(2 * np.pi * steps / 400)
M = operator.magnetization(field, corners=24)
fig, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
axes[0].plot(field)
axes[0].set(xlabel="sample", ylabel="field / (A/m)", title="a decaying field")
axes[1].plot(field, M)
axes[1].axvline(0, color="0.4", ls=":")
axes[1].set(xlabel="field / (A/m)", ylabel="magnetization, relative", title="its nested loops")
plt.show()

# %% [markdown]
# ## Where the memory is
# The same run in the plane of thresholds: which relays are up (dark) after three stages of it. The border between up and down is
# all that the past leaves: a staircase with a corner for each reversal that no larger one has wiped out.

# %%
states = np.asarray(relay_states(operator, field, "hard"))
triangle = np.tri(operator.cells, dtype=bool)
fig, axes = plt.subplots(1, 3, figsize=(10, 3.7), layout="constrained", sharey=True)
for ax, k in zip(axes, (300, 700, 1500), strict=True):
    ax.imshow(np.where(triangle, states[k], np.nan), origin="lower", extent=(-1000, 1000) * 2, cmap="Blues", vmin=-2, vmax=1.5)
    ax.set(xlabel="lower threshold / (A/m)", title=f"sample {k}: {field[k]:.0f} A/m")
axes[0].set_ylabel("upper threshold / (A/m)")
plt.show()

# %% [markdown]
# ## Relays, smeared
# A grid of point relays jumps and has no gradient. Spreading each mass over its cell gives a continuous operator with exact
# gradients. A relay of finite slope ("kp") lies between: on a rising field it all but hides the smeared one, and the lower strip
# tells them apart.

# %%
coarse = Preisach(gaussian_lorentzian_masses(8, -1000.0, 1000.0, 1.0, 0.0, 300.0, 150.0, 200.0), -1000.0, 1000.0)
up = np.linspace(-1000, 1000, 600)
curves = {name: coarse.magnetization(up, surrogate=name) for name in ("hard", "kp", "uniform")}
fig, axes = plt.subplots(2, 1, figsize=(8, 5.5), layout="constrained", sharex=True, height_ratios=(3, 1))
for (name, curve), style in zip(curves.items(), ("C0-", "C1-", "k--"), strict=True):
    axes[0].plot(up, curve, style, lw=2, label=name)
axes[1].plot(up, curves["kp"] - curves["uniform"], "C1-", lw=2)
axes[0].set(ylabel="magnetization, relative")
axes[1].set(xlabel="field / (A/m)", ylabel="kp − uniform")
axes[0].legend()
plt.show()

# %% [markdown]
# ## Rate
# Behind a coil with eddy currents and a mechanical mode, the loop of displacement against current turns with frequency.

# %%
actuator = load_bench("aa-050h").actuator()
current = 0.1 + 0.8 * np.sin(2 * np.pi * np.arange(500) / 500)
fig, ax = plt.subplots(figsize=(8, 4.5), layout="constrained")
for f, colour in zip((10, 50, 100, 200, 300), plt.cm.viridis(np.linspace(0, 0.9, 5)), strict=True):
    signals = simulate(actuator, current, 1 / (500 * f), periodic=True)
    ax.plot(current, np.asarray(signals.displacement) * 1e6, color=colour, label=f"{f} Hz", lw=2)
ax.set(xlabel="current / A", ylabel="displacement / µm")
fig.legend(loc="outside right center")
plt.show()

# %% [markdown]
# ## Gradients of anything
# The chain is differentiable: here the sensitivity of the largest displacement to the eddy resistance, at 200 Hz, beside the
# difference of two runs.

# %%
drive = jax.numpy.asarray(current)
largest = lambda R: run_chain(actuator.replace({"coil.R_eddy": R}), drive, 1e-5, 3, 4).displacement.max()
print(f"derivative  {float(jax.grad(largest)(70.0)) * 1e9:.4f} nm per ohm")
print(f"difference  {float(largest(70.01) - largest(69.99)) / 0.02 * 1e9:.4f} nm per ohm")
