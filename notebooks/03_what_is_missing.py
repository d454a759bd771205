# %% [markdown]
# # 3. What is missing
# The same bench, but its rod has domain-wall losses that the model does not have. The fit looks good to the
# eye and its constants are wrong. The diagnosis says where, what, and what the plain model had got wrong to hide it.

# %%
from textwrap import fill

import jax
import matplotlib.pyplot as plt
import numpy as np

jax.config.update("jax_enable_x64", True)
from fitting import diagnose
from fitting.check import prediction
from fitting.demo import SINES, TRUTH, concealed_actuator, record
from magjax.bench import load_bench
from magjax.effects.excess_loss import ExcessLoss

plt.rcParams["font.size"] = 11

# %%
bench = load_bench("aa-050h")
true = concealed_actuator(bench, ExcessLoss(k=25.0))
rng = np.random.default_rng(1)
recordings = [record(true, f, A, b, rng, f"{f} Hz") for f, A, b in SINES]
check = record(true, 70, 0.6, 0.05, rng, "check 70 Hz")  # takes no part in any fit

# %% [markdown]
# ## The diagnosis
# First the data, then the noise, solver and density floors, then the score of every effect of the catalogue off everything that
# the base could do, then real fits of the leaders.

# %%
found = diagnose(recordings, bench, check=[check])
print(fill(str(found), 110))

# %% [markdown]
# ## Good to the eye, and yet
# The check recording, foretold by the plain model and by the repaired one. The loops differ by a hair; the strips below them, ten
# times enlarged, tell all: before, a misfit of up to 0.7 um on the rising branch; after, noise.

# %%
fig, axes = plt.subplots(2, 2, figsize=(10, 6.5), layout="constrained", height_ratios=(3, 1.3), sharey="row")
for k, (result, title) in enumerate(((found.base, "before: the plain model"), (found.repaired, "after: repaired"))):
    predicted, measured, noise = prediction(result.actuator, check, bench)
    axes[0, k].plot(check.channels["current"][:1000], measured[:1000] * 1e6, "C0", lw=5, alpha=0.4, label="measured")
    axes[0, k].plot(check.channels["current"][:1000], predicted[:1000] * 1e6, "k--", lw=1.2, label="foretold")
    axes[0, k].set(title=title, xlabel="current / A")
    axes[1, k].plot(np.arange(1000) / 1000, (predicted - measured)[:1000] * 1e9, "k", lw=0.6)
    axes[1, k].axhspan(-2e9 * noise, 2e9 * noise, color="C0", alpha=0.25)
    axes[1, k].set(xlabel="part of the period (band: twice the noise)")
axes[0, 0].set_ylabel("displacement / µm")
axes[1, 0].set_ylabel("difference / nm")
axes[0, 0].legend(loc="lower right")
plt.show()

# %% [markdown]
# ## Who else could it have been
# z is the score in standard deviations: what an effect could take of the misfit that the plain model cannot imitate. Many effects
# score, for one misfit looks a little like another. Blue are those that were fitted for real; only the fit decides.

# %%
leaders = found.candidates[15::-1]
fig, ax = plt.subplots(figsize=(9, 5), layout="constrained")
colours = ["C0" if c.achieved_chi2_drop else "0.75" for c in leaders]
ax.barh([c.name.replace("_", " ") for c in leaders], [abs(c.z) for c in leaders], color=colours)
ax.axvline(5.5, color="C3", ls="--", label="what counts: 5.5")
ax.set(xlabel="score |z| / standard deviations")
ax.legend(loc="lower right")
plt.show()

# %%
for c in found.candidates[:16]:
    if c.achieved_chi2_drop:
        print(f"{c.name:26s} promised {c.predicted_chi2_drop:6.0f}, took {c.achieved_chi2_drop:6.0f} of chi2")

# %% [markdown]
# ## What the plain model had got wrong to hide it
# The eddy resistance had stood in for the missing loss. Its error bar knew nothing of that: an error bar holds only where nothing
# is missing.

# %%
for effect in found.effects:
    print(effect["name"], *(f"{k} = {p['value']:.3g} +- {p['stderr']:.2g} {p['unit']}" for k, p in effect["parameters"].items()))
fig, axes = plt.subplots(1, 3, figsize=(10, 3.4), layout="constrained")
for ax, (name, value) in zip(axes, TRUTH.items(), strict=True):
    for k, e in enumerate(r.estimate(name) for r in (found.base, found.repaired)):
        ax.errorbar([k], [e.value], [2 * e.stderr], fmt="so"[k], ms=7, capsize=6)
    ax.axhline(value, color="0.4", ls="--", label="true")
    ax.set(
        ylabel=name if e.unit == "1" else f"{name} / {e.unit}", xticks=[0, 1], xticklabels=["plain", "repaired"], xlim=(-0.5, 1.5)
    )
axes[0].legend(loc="lower right")
fig.suptitle("the constants before and after (bars: two standard errors)")
plt.show()
