# %% [markdown]
# # 5. l1 design
# How large can the tracking error get for *any* reference and *any* inversion error within their bounds, while the control never
# saturates? That peak is an l1 norm, and the best controller a linear programme.

# %%
import matplotlib.pyplot as plt
import numpy as np

from magjax.control import TrackingProblem, design, optimal_sensitivity
from magjax.control.l1 import knee
from magjax.control.problem import response
from magjax.control.realize import reduced_controller

plt.rcParams["font.size"] = 11

# %% [markdown]
# ## The paper's problem
# References up to 30 um, inversion errors up to 0.1 M_s^2, control up to 3.25 M_s^2. The bounds of gamma* enclose it.

# %%
made = design(TrackingProblem(u_bar=3.25))
print(f"gamma* between {made.lower:.6f} and {made.gamma:.6f} um; largest control {made.control:.4f} M_s^2")
controller = reduced_controller(made)
print(f"order {controller.order} on its model:", controller.margins())

# %% [markdown]
# ## What the programme found
# The taps of Q, and what they leave of a pulse in the reference and in the inversion error. The peak of the error is the sum of
# these bars' sizes, each times its bound.

# %%
N, problem = 40, made.problem
Q = made.Q[:N]
G = np.append(0.0, response(*problem.plant, N - 1))
loop = np.append(0.0, np.convolve(G, Q)[: N - 1])
from_r = np.eye(N)[2] - loop
from_w = -np.convolve(G, np.eye(N)[0] - loop)[:N]
fig, axes = plt.subplots(1, 3, figsize=(11, 3.8), layout="constrained")
shown = (
    (Q, "the taps of Q", "M_s² per µm"),
    (from_r, "error after a pulse in the reference", "µm per µm"),
    (from_w, "after one in the inversion error", "µm per M_s²"),
)
for ax, (pulse, title, unit) in zip(axes, shown, strict=True):
    ax.stem(np.arange(16), pulse[:16], basefmt="0.7")
    ax.set(xlabel="sample (0.5 ms)", ylabel=unit, title=title)
    ax.title.set_fontsize(11)
plt.show()

# %% [markdown]
# ## The worst that can happen
# The inputs that add up all the bars stand at their limits and change sides as the signs of the pulses say. Left, what is worst for
# the error: at the last sample it is gamma*. Right, what is worst for the control: at the last sample it is u_bar, just not
# saturated. No admissible reference and inversion error do worse (dashed: the limits).

# %%
signs = lambda pulse: np.where(np.round(pulse[::-1], 6) < 0, -1.0, 1.0)
to_u = np.append(0.0, Q[:-1]), -loop
fig, axes = plt.subplots(4, 2, figsize=(11, 8), layout="constrained", sharex=True, sharey="row")
for column, (of_r, of_w), title in zip(
    axes.T, ((from_r, from_w), to_u), ("worst for the error", "worst for the control"), strict=True
):
    r, w = problem.r_bar * signs(of_r), problem.w_bar * signs(of_w)
    e, u = ((np.convolve(by_r, r) + np.convolve(by_w, w))[:N] for by_r, by_w in ((from_r, from_w), to_u))
    print(f"{title}: at the last sample an error of {e[-1]:.4f} um, a control of {u[-1]:.4f} M_s^2")
    limits = (problem.r_bar, problem.w_bar, made.gamma, problem.u_bar)
    for ax, curve, limit in zip(column, (r, w, e, u), limits, strict=True):
        ax.step(0.5 * np.arange(N), curve, where="mid")
        ax.hlines((-limit, limit), 0, 0.5 * N, "C3", "--", lw=1)
    column[0].set_title(title)
    column[3].set_xlabel("time / ms")
for ax, name in zip(axes[:, 0], ("reference / µm", "inversion error / M_s²", "error / µm", "control / M_s²"), strict=True):
    ax.set_ylabel(name)
plt.show()

# %% [markdown]
# ## The price of saturation (Fig. 15)
# gamma* falls with u_bar and is flat beyond the knee, where Q = 1/g is feasible. The sample time is an assumption: 0.5 ms.

# %%
u_star, flat = knee(TrackingProblem())
u_bars = np.linspace(0.5, 6, 23)
fig, ax = plt.subplots(figsize=(8, 4), layout="constrained")
ax.plot(u_bars, [design(TrackingProblem(u_bar=u)).gamma for u in u_bars], "o-", ms=4)
ax.axvline(u_star, color="0.5", ls=":")
ax.annotate("knee", (u_star, 25), (u_star + 0.1, 25))
ax.plot(3.25, made.gamma, "C3s", label="the paper's problem")
ax.set(xlabel="u_bar / M_s²", ylabel="gamma* / µm")
ax.legend()
print(f"knee at {u_star:.9f} M_s^2, flat at {flat:.9f} um")
plt.show()

# %% [markdown]
# ## Exact answers
# Without weights the optimum is rational. For a delay and an unstable pole at 1/2 no controller does better than 3.

# %%
for zeros, poles in (((0,), ("1/2",)), ((0, "1/2"), ("2/3",)), (("1/2",), ("4/5",))):
    print("zeros", zeros, "poles", poles, "->", optimal_sensitivity(zeros, poles).value)
