# %% [markdown]
# # 5. l1 design
# How large can the tracking error get for *any* reference and *any* inversion error within their bounds, while the control never
# saturates? That peak is an l1 norm, and the best controller a linear programme.

# %%
import matplotlib.pyplot as plt
import numpy as np

from magjax.control import TrackingProblem, design, optimal_sensitivity
from magjax.control.l1 import knee
from magjax.control.realize import reduced_controller

# %% [markdown]
# ## The paper's problem
# References up to 30 um, inversion errors up to 0.1 M_s^2, control up to 3.25 M_s^2. The bounds of gamma* enclose it.

# %%
made = design(TrackingProblem(u_bar=3.25))
print(f"gamma* between {made.lower:.6f} and {made.gamma:.6f} um; largest control {made.control:.4f} M_s^2")
controller = reduced_controller(made)
print(f"order {controller.order} on its model:", controller.margins())

# %% [markdown]
# ## The price of saturation (Fig. 15)
# gamma* falls with u_bar and is flat beyond the knee, where Q = 1/g is feasible. The sample time is an assumption: 0.5 ms.

# %%
u_star, flat = knee(TrackingProblem())
u_bars = np.linspace(0.5, 6, 23)
plt.plot(u_bars, [design(TrackingProblem(u_bar=u)).gamma for u in u_bars], "o-", ms=3)
plt.axvline(u_star, color="0.6", ls=":")
plt.gcf().set_size_inches(5, 3.2)
plt.xlabel("u_bar, M_s^2")
plt.ylabel("gamma*, um")
print(f"knee at {u_star:.9f} M_s^2, flat at {flat:.9f} um")

# %% [markdown]
# ## Exact answers
# Without weights the optimum is rational. For a delay and an unstable pole at 1/2 no controller does better than 3.

# %%
for zeros, poles in (((0,), ("1/2",)), ((0, "1/2"), ("2/3",)), (("1/2",), ("4/5",))):
    print("zeros", zeros, "poles", poles, "->", optimal_sensitivity(zeros, poles).value)
