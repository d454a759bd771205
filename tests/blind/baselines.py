"""The usual ways, on the same concealed benches: `python -m tests.blind.baselines test` prints their table.

Each is given what magjax has not: the exact laws, the true base bench, a converged base fit. Only the way of choosing is its own.
  stepwise AIC     raw sensitivities added to the residual's regression while AIC falls, the base held
  correlation      the raw sensitivity with the largest cosine to the residual, where its score exceeds 5
  sparse           lasso on the raw sensitivities, its weight by BIC, names above a tenth of the largest
  GP discrepancy   a Gaussian process in (current, rate) on the residual: says that something is missing, names nothing
  projected        for comparison: the largest score off the base's tangent, where it exceeds 5
"""

import argparse
import json
from collections import defaultdict
from pathlib import Path

import numpy as np

from .cases import SUITES, make_case, size
from .oracle import Sight
from .score import wilson
from .strengths import VISIBLE

FILE = Path(__file__).with_name("BASELINES.json")
WAYS = ("stepwise AIC", "correlation", "sparse", "GP discrepancy", "projected")


def stepwise(e, S, names):
    """Names taken by forward selection with AIC (two for a parameter)."""
    chosen, best = [], e @ e
    while True:
        tries = []
        for k in range(len(names)):
            if k not in chosen:
                A = S[:, [*chosen, k]]
                x, *_ = np.linalg.lstsq(A, e, rcond=None)
                tries.append((np.sum((e - A @ x) ** 2), k))
        if not tries or len(chosen) > 8 or min(tries)[0] + 2 > best:
            return {names[k] for k in chosen}
        chi, k = min(tries)
        chosen, best = [*chosen, k], chi


def correlation(e, S, names):
    """The best single match."""
    score = S.T @ e / np.linalg.norm(S, axis=0)
    k = int(np.argmax(np.abs(score)))
    return {names[k]} if abs(score[k]) > 5 else set()


def sparse(e, S, names):
    """Lasso by coordinate descent on a path of weights, chosen by BIC."""
    X = S / np.linalg.norm(S, axis=0)
    G, c = X.T @ X, X.T @ e
    best, taken, x = e @ e, set(), np.zeros(len(names))
    for weight in np.abs(c).max() * np.logspace(0, -3, 20):
        for _ in range(200):
            for k in range(len(names)):
                free = c[k] - G[k] @ x + G[k, k] * x[k]
                x[k] = np.sign(free) * max(abs(free) - weight, 0) / G[k, k]
        bic = e @ e - 2 * c @ x + x @ G @ x + np.log(len(e)) * np.sum(x != 0)
        if bic < best - 10:
            best, taken = bic, {names[k] for k in range(len(names)) if abs(x[k]) > 0.1 * np.abs(x).max()}
    return taken


def gp(e, sight):
    """Whether a smooth function of current and its rate (random features) takes up more than its number of parameters."""
    rng = np.random.default_rng(1)
    I = np.tile(sight.settled["current"], (1, 4))
    rate = np.gradient(I, axis=1) * sight.frequency[:, None]
    x = np.stack([I.ravel() / I.std(), rate.ravel() / rate.std()])
    Z = np.cos(rng.normal(size=(120, 2)) * 1.5 @ x + rng.uniform(0, 2 * np.pi, (120, 1))).T
    Q, _ = np.linalg.qr(Z)
    return {"?"} if np.sum((Q.T @ e) ** 2) > 120 + 5 * np.sqrt(240) else set()


def choose(case):
    """What each way names for a case: way -> names."""
    sight = Sight(case)
    rng = np.random.default_rng(case.seed + 4 * 10**6)
    e = sight.remove(sight.trace(case.effects) + rng.normal(size=len(sight.sigma)))
    names = list(VISIBLE)
    S = np.stack([sight.trace({n: VISIBLE[n][0]}) for n in names], axis=1)
    projected = np.stack([sight.remove(s) for s in S.T], axis=1)
    score = np.abs(projected.T @ e) / np.sqrt(np.maximum(np.sum(S * projected, axis=0), 1e-9))
    k = int(np.argmax(score))
    return {
        "stepwise AIC": stepwise(e, S, names),
        "correlation": correlation(e, S, names),
        "sparse": sparse(e, S, names),
        "GP discrepancy": gp(e, sight),
        "projected": {names[k]} if score[k] > 5 else set(),
    }


def table(found) -> str:
    """Markdown: shares of nulls that stay silent, of singles named exactly, of outside cases left unnamed."""
    counts = defaultdict(lambda: defaultdict(list))
    for name, said in found.items():
        suite, number = name.split("-")
        case = make_case(suite, int(number))
        for way, names in said.items():
            if case.kind == "null":
                counts[way]["nulls silent"].append(not names)
            elif case.kind == "single":
                counts[way]["singles named exactly"].append(set(names) == set(case.effects))
                counts[way]["singles, the truth among the named"].append(set(case.effects) <= set(names))
            elif case.kind == "pair":
                counts[way]["pairs named exactly"].append(set(names) == set(case.effects))
            elif case.kind == "outside":
                counts[way]["outside, not misnamed"].append(not set(names) - {"?"})
    heads = (
        "nulls silent",
        "singles named exactly",
        "singles, the truth among the named",
        "pairs named exactly",
        "outside, not misnamed",
    )
    lines = ["| way | " + " | ".join(heads) + " |", "|---|" + "---|" * len(heads)]
    for way in WAYS:
        cells = []
        for head in heads:
            got = counts[way][head]
            low, high = wilson(sum(got), len(got))
            cells.append(f"{sum(got)}/{len(got)} ({low:.0%} to {high:.0%})")
        lines.append(f"| {way} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def as_text(found) -> str:
    """JSON with a line a case."""
    lines = (f"{json.dumps(name)}: {json.dumps(said, sort_keys=True)}" for name, said in sorted(found.items()))
    return "{\n" + ",\n".join(lines) + "\n}\n"


def main():
    """Run what is not done yet, keep it in BASELINES.json, print the table."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("suite", choices=list(SUITES))
    p.add_argument("--numbers", type=int, nargs="*")
    options = p.parse_args()
    found = json.loads(FILE.read_text()) if FILE.exists() else {}
    for k in range(size(options.suite)) if options.numbers is None else options.numbers:
        case = make_case(options.suite, k)
        if case.name not in found and case.kind in ("null", "single", "pair", "outside"):
            found[case.name] = {way: sorted(names) for way, names in choose(case).items()}
            FILE.write_text(as_text(found))
            print(case.name, case.effects, found[case.name], flush=True)
    print(table({n: s for n, s in found.items() if n.startswith(options.suite)}))


if __name__ == "__main__":
    main()
