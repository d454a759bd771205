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

plant = PlainActuator.from_actuator(load_bench("aa-050h").actuator())

# %% [markdown]
# ## The inverse is exact
# A thousand random magnetizations, each reached to rounding.

# %%
operator = plant.operator.copy()
targets = operator.offset + 0.95 * operator.total * np.random.default_rng(0).uniform(-1, 1, 1000)
check = operator.copy()
errors = [abs(check.apply(operator.solve(float(m))) - m) for m in targets]
print("largest error:", max(errors) / plant.M_s, "of M_s")

# %% [markdown]
# ## Four ways to follow 20 Hz
# As in the paper's Fig. 10: feedback alone is poor, the static inverse lags, the dynamic inverse follows.

# %%
time, wanted = sinusoid(plant, 5e-4)
fig, axes = plt.subplots(2, 4, figsize=(13, 5), sharex=True, layout="constrained")
for k, strategy in enumerate(("proportional", "static_inverse", "dynamic_inverse", "l1")):
    run = track(plant, plant, time, wanted, strategy)
    axes[0, k].plot(time, wanted * 1e6, "0.6", time, run.reached * 1e6, "C0")
    axes[0, k].set_title(f"{strategy}: {run.errors()[0] * 1e6:.2f} um rms")
    axes[1, k].plot(time, (run.reached - wanted) * 1e6, "C3")

# %% [markdown]
# ## Bounds, and how loose they are
# Proposition 4.3 holds always and says little here: read it beside a simulated worst case.

# %%
bound = backward_bound(plant, 5e-4)
print(
    f"Prop. 4.3: {bound.share:.2f} of the saturation, simulated worst {simulated_worst(plant, 5e-4, bound.g_bar, trials=4, length=60) / plant.operator.total:.2f}"
)
print(bound.note)
