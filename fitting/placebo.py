"""The placebo: does the screening alarm on recordings that lack nothing?

The final model stands in for the truth: its harmonics with fresh noise of the stated size are fitted and screened as the
recordings were. What scores above the threshold there is a false alarm of the screening. It names nothing yet: the fits of
the leaders with their gates, which a diagnosis goes on to, are not run here. A rough truth that the density cannot follow is not
in it: that is what the check recordings and the blind suites are for.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .joint import solve
from .model import predicted_lines
from .screen import screen
from .uncertainty import UNDERSMOOTH


def placebo(result, threshold: float, runs: int = 20, seed: int = 0, without=(), progress=None) -> dict:
    """Fit and screen the model's own recordings `runs` times; {"runs", "false_alarms", "named", "highest_z"}.

    `result`: the `FitResult` of the final model; `threshold`: |z| of an alarm; `without`: effects that are not asked for.
    """
    say = progress or (lambda *a: None)
    random = np.random.default_rng(seed)
    problem, solution = result.problem, result.solution
    exact = np.asarray(predicted_lines(problem.predictors[1], problem.layout.actuator(problem.template, jnp.asarray(solution.z))))
    deviations = np.where(np.isfinite(np.asarray(problem.target.deviations)), np.asarray(problem.target.deviations), 0.0)
    named, highest = {}, []
    for k in range(runs):
        say(f"placebo {k + 1} of {runs}", 0, None)
        noise = random.normal(size=exact.shape) + 1j * random.normal(size=exact.shape) * (np.arange(exact.shape[1]) > 0)
        target = eqx.tree_at(lambda t: t.lines, problem.target, jnp.asarray(exact + deviations * noise))
        again = dataclasses.replace(problem, target=target)
        found = solve(again, solution.z, solution.weights, max_jacobians=8)
        loose = solve(again, found.z, UNDERSMOOTH * found.weights, max_jacobians=4, evidence=False)
        best = next(c for c in screen(again, loose) if c.name not in without)
        highest.append(float(abs(best.z)))
        if abs(best.z) > threshold:
            named[best.name] = named.get(best.name, 0) + 1
    return {"runs": runs, "false_alarms": sum(named.values()), "named": named, "highest_z": highest}
