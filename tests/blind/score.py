"""Score a suite: `python -m tests.blind.score dev --out results` prints the table in Markdown.

A single counts as right if it is named alone, as grouped if the true name stands in the group; instruments' lags are
one family where they are weak. Shares carry Wilson intervals of 95 %.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from .cases import SUITES, make_case


def wilson(right, total, z=1.96):
    """(low, high) of a share."""
    if total == 0:
        return 0.0, 1.0
    p = right / total
    centre, spread = p + z * z / (2 * total), z * np.sqrt(p * (1 - p) / total + z * z / (4 * total**2))
    return (centre - spread) / (1 + z * z / total), (centre + spread) / (1 + z * z / total)


def judge(case, diagnosis) -> str:
    """"right", "group", "partly", "silent", "wrong", "unknown", "data_problem"."""
    verdict = diagnosis["verdict"]
    named = {e["name"] for e in diagnosis["effects"]}
    grouped = {n for g in diagnosis["groups"] for n in g}
    truth = set(case.effects)
    if verdict == "data_problem":
        return "data_problem"
    if case.kind == "outside":
        return "right" if verdict == "unknown_at" else "silent" if verdict in ("nothing_missing", "absorbed") else "wrong"
    if case.kind == "hidden":
        return "right" if verdict in ("nothing_missing", "absorbed") or named == truth else "group" if truth <= named | grouped else "wrong"
    if not truth:
        return "right" if verdict in ("nothing_missing", "absorbed") else "wrong"
    if verdict in ("nothing_missing", "absorbed"):
        return "silent"
    if verdict == "unknown_at":
        return "unknown"
    if named == truth and not grouped:
        return "right"
    if truth <= named | grouped:
        return "group" if len(named - truth) == 0 else "partly"
    return "partly" if truth & (named | grouped) else "wrong"


def read(suite, out):
    """(case, diagnosis or None, seconds) of every case that is done."""
    rows = []
    for k in range(SUITES[suite]):
        case = make_case(suite, k)
        folder = Path(out) / case.name
        if not (folder / "done.json").exists():
            continue
        done = json.loads((folder / "done.json").read_text())
        path = folder / "result" / "diagnosis.json"
        rows.append((case, json.loads(path.read_text()) if path.exists() else None, done))
    return rows


def main():
    """Print the table and, with --cases, every case."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("suite", choices=list(SUITES))
    p.add_argument("--out", default="blind-results")
    p.add_argument("--cases", action="store_true")
    options = p.parse_args()
    rows = read(options.suite, options.out)
    table, seconds, checks = {}, [], []
    for case, diagnosis, done in rows:
        verdict = judge(case, diagnosis) if diagnosis else f"failed ({done['status']})"
        key = case.kind if case.kind == "null" else f"{case.kind}, {case.strength}"
        table.setdefault(key, []).append(verdict)
        seconds.append(done["seconds"])
        ratios = [c["rms_after"] / max(c["noise_rms"], 1e-12) for c in diagnosis["check"]] if diagnosis else []
        before = [c["rms_before"] / max(c["noise_rms"], 1e-12) for c in diagnosis["check"]] if diagnosis else []
        checks += ratios
        if options.cases:
            said = diagnosis and (diagnosis["verdict"], [e["name"] for e in diagnosis["effects"]], diagnosis["groups"])
            chi = diagnosis and [round((diagnosis[k] or {}).get("chi2_per_sample", float("nan")), 2) for k in ("base", "repaired")]
            print(case.name, case.kind, case.strength, case.density, case.start, case.effects, "->", verdict, said, chi, np.round(before, 1), np.round(ratios, 1), round(done["seconds"]))
    outcomes = sorted({v for vs in table.values() for v in vs})
    print(f"\n| {options.suite}: {len(rows)} cases | " + " | ".join(outcomes) + " | right or grouped, 95 % |")
    print("|---|" + "---|" * (len(outcomes) + 1))
    for key, verdicts in sorted(table.items()):
        good = sum(v in ("right", "group") for v in verdicts)
        low, high = wilson(good, len(verdicts))
        print(f"| {key} | " + " | ".join(str(verdicts.count(o)) for o in outcomes) + f" | {good}/{len(verdicts)}: {low:.0%}-{high:.0%} |")
    if checks:
        print(f"\nCheck error over noise: median {np.median(checks):.2f}, 90th percentile {np.quantile(checks, 0.9):.2f}; median time {np.median(seconds):.0f} s.")


if __name__ == "__main__":
    main()
