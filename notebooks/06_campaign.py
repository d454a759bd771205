# %% [markdown]
# # 6. A campaign on the bench
# From a list of drives to a repaired model, on a bench that is a device behind a serial port. Here the device is emulated: `magjax
# emulate` plays an actuator with other constants than its file says, noise, 16-bit counts, and one piece of physics that the model
# lacks. With a real one only the port changes.

# %%
import json
import os
import subprocess
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small dense solves: more threads only wait for each other
import matplotlib.pyplot as plt
import numpy as np

from fitting import fit
from fitting.screen import screen
from fitting.setup import Choices
from magjax.acquire.response import effect_of
from magjax.cli.runtime import prepare_jax
from magjax.recording import load_recordings

prepare_jax()
plt.rcParams["font.size"] = 11
QUICK = "MAGJAX_QUICK" in os.environ  # fewer drives, and the ranking left out
magjax = [sys.executable, "-m", "magjax"]
folder = Path("campaign")
folder.mkdir(exist_ok=True)

# %% [markdown]
# ## Plan, bench and recorder
# Slow and fast, small and large: what one frequency cannot tell from another effect, the next one can. The bench names its port and
# waits. The recorder checks the plan against the limits, then each recording as it comes: samples lost, clipping, transients. A bad
# one is repeated, and the same command goes on after an interruption.

# %%
plan = """
samples = 500
periods = 4
settle = 4
demagnetize = false
[[drives]]
frequency = [10, 50, 200]
amplitude = 0.8
offset = 0.1
"""
more = "[[drives]]\nfrequency = [20, 100, 300]\namplitude = 0.5\n"
(folder / "plan.toml").write_text(plan if QUICK else plan + more)

hidden = "quartic_magnetostriction:b=0.15"
bench = subprocess.Popen([*magjax, "emulate", "--hide", hidden, "--fast", "--json"], stdout=subprocess.PIPE, text=True)
port = json.loads(bench.stdout.readline())["port"]
record = [*magjax, "record", port, "--plan", str(folder / "plan.toml"), "--out", str(folder / "study"), "--quiet"]
print(subprocess.run(record, capture_output=True, text=True, check=True).stdout)
bench.terminate()
bench.wait()
bench.stdout.close()

# %% [markdown]
# ## Look before you fit
# Loops as they came, and what the periods differ by: that is the noise, known without any model.

# %%
recordings = load_recordings(sorted((folder / "study").glob("*.mjlog")), "aa-050h")
recordings.sort(key=lambda r: r.frequency())
fig, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
for r, colour in zip(recordings, plt.cm.viridis(np.linspace(0, 0.9, len(recordings))), strict=True):
    y = r.repeats("displacement")
    axes[0].plot(r.repeats("current")[0], y.mean(axis=0) * 1e6, color=colour, lw=2, label=f"{r.frequency():.0f} Hz")
    axes[1].plot(np.arange(y.shape[1]) / y.shape[1], (y[0] - y.mean(axis=0)) * 1e9, ".", color=colour, ms=2)
axes[0].set(xlabel="current / A", ylabel="displacement / µm", title="mean loops")
axes[1].set(xlabel="part of the period", ylabel="difference / nm", title="first period less the mean: noise, no trend")
fig.legend(*axes[0].get_legend_handles_labels(), loc="outside right center")
plt.show()

# %% [markdown]
# ## Fit
# The plain model meets the loops to ten nanometres beside the noise. To the eye that is perfect. chi2/N says that it is not.

# %%
choices = Choices(rest="negative")  # the emulated bench starts saturated; "auto" would try other pasts, too
base = fit(recordings, "aa-050h", refine=False, choices=choices)
print(base)

# %% [markdown]
# ## What is hidden
# Every effect of the catalogue is asked how much of the misfit it could take that the plain model cannot imitate, in standard
# deviations. One stands out. `magjax diagnose` goes on from here: real fits of the leaders, groups, checks, the next experiment.

# %%
ranking = [] if QUICK else screen(base.problem, base.refined)
leaders = ranking[11::-1]
fig, ax = plt.subplots(figsize=(9, 4.2), layout="constrained")
ax.barh([c.name.replace("_", " ") for c in leaders], [abs(c.z) for c in leaders], color=["0.75"] * len(leaders[1:]) + ["C0"])
ax.axvline(5.5, color="C3", ls="--", label="what counts: 5.5")
ax.set(xlabel="score |z| / standard deviations")
ax.legend(loc="lower right")
plt.show()

# %% [markdown]
# ## The repair
# The leader joins the model and everything is fitted again, its strength too.

# %%
leader = ranking[0].name if ranking else "quartic_magnetostriction"
effect = effect_of(leader, ranking[0].shapes if ranking else {}).with_amplitude(ranking[0].amplitude if ranking else 0.1)
names = [f"effects.{leader}.{q}" for q in effect.free_parameters()]
repaired = fit(recordings, "aa-050h", actuator=base.actuator.with_effect(effect), extra=names, refine=False, choices=choices)
print(repaired)

# %% [markdown]
# ## What the plain model had got wrong to hide it
# The bench was made with 62 ohm, 405 Hz, 0.81 and b = 0.15. The plain fit states small errors about wrong values: an error bar
# holds only where nothing is missing.

# %%
true = {"coil.R_eddy": 62.0, "mechanics.f0": 405.0, "mechanics.xi": 0.81}
fig, ax = plt.subplots(figsize=(9, 3.6), layout="constrained")
for k, (result, word) in enumerate(((base, "plain"), (repaired, f"with {leader.replace('_', ' ')}"))):
    off = [(result.estimate(n).value - v) / result.estimate(n).stderr for n, v in true.items()]
    ax.plot(off, np.arange(3) + 0.15 * k, "so"[k], ms=9, label=f"{word}: chi2/N = {result.chi2_per_sample:.2f}")
ax.axvspan(-2, 2, color="0.9", label="two standard errors")
ax.set(yticks=np.arange(3), yticklabels=list(true), ylim=(-0.5, 2.6), xlabel="distance from the truth / standard errors")
fig.legend(loc="outside lower center", ncols=3)
plt.show()
print(f"{names[0]} = {repaired.estimate(names[0]).value:.3f} +- {repaired.estimate(names[0]).stderr:.3f}")
