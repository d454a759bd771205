# %% [markdown]
# # 4. Invert and track
# To make the actuator follow a trajectory, run the model backwards: displacement to magnetization by (5), magnetization to field by
# the exact inverse of the Preisach operator, field to current by (7).

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

jax.config.update("jax_enable_x64", True)
from magjax.bench import load_bench
from magjax.control.tracking import sinusoid, track
from magjax.inverse import PlainActuator
from magjax.inverse.bounds import backward_bound, simulated_worst

plt.rcParams["font.size"] = 11
plant = PlainActuator.from_actuator(load_bench("aa-050h").actuator())

# %% [markdown]
# ## The inverse is exact
# A thousand random magnetizations, each reached to rounding.

# %%
operator = plant.operator.copy()
targets = operator.offset + 0.95 * operator.total * np.random.default_rng(0).uniform(-1, 1, 1000)
check = operator.copy()
errors = [abs(check.apply(operator.solve(float(m))) - m) for m in targets]
print(f"largest error: {max(errors) / plant.M_s:.1e} of M_s")

# %% [markdown]
# ## Four ways to follow 20 Hz
# As in the paper's Fig. 10: feedback alone is poor, the static inverse lags, the dynamic inverse follows: it has the right model.
# The l1 controller is made for the worst reference and a wrong model; on a gentle sinusoid and a right one it pays for that.

# %%
time, wanted = sinusoid(plant, 5e-4)
strategies = ("proportional", "static_inverse", "dynamic_inverse", "l1")
runs = [track(plant, plant, time, wanted, strategy) for strategy in strategies]

# %%
fig, axes = plt.subplots(2, 4, figsize=(12, 5.6), sharex=True, sharey="row", layout="constrained")
late = slice(500, 798)
for ax, below, run in zip(*axes, runs, strict=True):
    ax.plot(time[late], run.wanted[late] * 1e6, "0.6", lw=4, label="wanted")
    ax.plot(time[late], run.reached[late] * 1e6, "C0", lw=1.5, label="reached")
    ax.set_title(run.strategy.replace("_", " "))
    below.plot(time[late], (run.reached - run.wanted)[late] * 1e6, "C3")
    below.set(xlabel="time / s", title=f"{run.errors()[0] * 1e6:.2f} µm rms")
axes[0, 0].set_ylabel("displacement / µm")
axes[1, 0].set_ylabel("error / µm")
fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
plt.show()

# %% [markdown]
# ## What the dynamic inverse adds
# Both inverses run open loop; their currents differ by less than 30 mA. What eddy currents and inertia will take away, the dynamic
# inverse adds beforehand.

# %%
static, dynamic = runs[1], runs[2]
fig, axes = plt.subplots(2, 1, figsize=(8, 5), sharex=True, layout="constrained", height_ratios=(2, 1))
axes[0].plot(time[late], static.current[late], "0.6", lw=4, label="static inverse")
axes[0].plot(time[late], dynamic.current[late], "C0", lw=1.5, label="dynamic inverse")
axes[1].plot(time[late], (dynamic.current - static.current)[late] * 1e3, "C0")
axes[0].set(ylabel="current / A")
fig.legend(loc="outside upper center", ncols=2)
axes[1].set(xlabel="time / s", ylabel="difference / mA")
plt.show()

# %% [markdown]
# ## Bounds, and how loose they are
# Proposition 4.3 holds always and says little here: read it beside a simulated worst case.

# %%
bound = backward_bound(plant, 5e-4)
worst = simulated_worst(plant, 5e-4, bound.g_bar, trials=4, length=60) / plant.operator.total
print(f"Prop. 4.3: {bound.share:.2f} of the saturation, simulated worst {worst:.2f}")
print(bound.note)
