# %% [markdown]
# # 3. What is missing
# The same bench, but its rod has domain-wall losses that the model does not have. The fit looks good to the
# eye and its constants are wrong. The diagnosis says where, what, and what the plain model had got wrong to hide it.

# %%
import jax
import numpy as np

jax.config.update("jax_enable_x64", True)
from fitting import diagnose
from fitting.demo import SINES, concealed_actuator, record
from magjax.bench import load_bench
from magjax.effects.excess_loss import ExcessLoss

# %%
bench = load_bench("aa-050h")
true = concealed_actuator(bench, ExcessLoss(k=25.0))
rng = np.random.default_rng(1)
recordings = [record(true, f, A, b, rng, f"{f} Hz") for f, A, b in SINES]
check = [record(true, 70, 0.6, 0.05, rng, "check 70 Hz")]

# %% [markdown]
# ## The diagnosis
# First the data, then the noise, solver and density floors, then the score of every effect of the catalogue off everything that
# the base could do, then real fits of the leaders.

# %%
found = diagnose(recordings, bench, check=check)
print(found)

# %% [markdown]
# ## Who else could it have been
# z is the score in standard deviations; "visible from" the smallest amplitude these recordings would show.

# %%
for c in found.candidates[:8]:
    print(f"{c.name:26s} z = {c.z:8.1f}   visible from {c.smallest_visible:.3g}")

# %% [markdown]
# ## What the plain model had got wrong, and the proof on the check recording

# %%
for effect in found.effects:
    print(effect["name"], {k: (round(p["value"], 3), round(p["stderr"], 3)) for k, p in effect["parameters"].items()})
    for name, (before, after) in effect["shifts"].items():
        print(f"   {name:14s} {before:9.4g} -> {after:9.4g}")
for row in found.check:
    print(
        f"{row['file']}: {row['rms_before'] * 1e9:.0f} nm before, {row['rms_after'] * 1e9:.0f} nm after, noise {row['noise_rms'] * 1e9:.0f} nm"
    )
