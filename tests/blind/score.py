"""Score a suite: `python -m tests.blind.score dev --out blind-results [--cases] [--table FILE] [--keep FILE.jsonl]`, Markdown.

--keep writes what the score is made from, one line a case; such a file serves as --out too, and as the runner's --kept.

Outcomes. right: exactly what is concealed is named, nothing else (nulls: silence; outside: unknown_at; data: data_problem or a
refusal). group: the truth stands in a group and nothing foreign is named. kin: another member of the truth's known group is named
alone. extra: the truth and something foreign. partly: one of two. silent: nothing is claimed. unknown: unknown_at. wrong: the rest.
Shares carry Wilson intervals of 95 %. Where ORACLE.json holds the z of what is concealed (what one who knows the law could see),
singles and pairs are told by it, too.
"""

import argparse
import itertools
import json
from collections import Counter
from pathlib import Path

import numpy as np

from .cases import SUITES, block_outside, make_case, seal, size
from .oracle import FILE as ORACLE
from .oracle import RIVALS
from .run import GENERATOR_FAILED
from .strengths import GROUPS

ORDER = ("right", "group", "kin", "extra", "partly", "silent", "unknown", "data_problem", "wrong", "failed")
QUIET = ("nothing_missing", "absorbed")


def wilson(right: int, total: int, z: float = 1.96):
    """(low, high) of a share."""
    if total == 0:
        return 0.0, 1.0
    p = right / total
    centre, spread = p + z * z / (2 * total), z * np.sqrt(p * (1 - p) / total + z * z / (4 * total**2))
    return max(centre - spread, 0.0) / (1 + z * z / total), (centre + spread) / (1 + z * z / total)


def kin(name: str) -> set:
    """Everything that shares a known group with `name`."""
    return {n for g in GROUPS if name in g for n in g} | {name}


def judge(case, diagnosis, status=0) -> str:
    """One of ORDER for a case's diagnosis (None where there is none)."""
    if diagnosis is None:
        if status == 3:
            return "right" if case.kind == "data" else "data_problem"
        return "failed"
    verdict = diagnosis["verdict"]
    named = {e["name"] for e in diagnosis["effects"]}
    grouped = {n for g in diagnosis["groups"] for n in g}
    truth = set(case.effects)
    if verdict == "data_problem":
        return "right" if case.kind == "data" else "data_problem"
    if case.kind == "data":  # a few missing rows may be mended and the rest believed
        mended = case.instruments["fault"] == "missing" and verdict in QUIET
        return "right" if mended else "silent" if not named | grouped else "wrong"
    if case.kind == "outside":
        return "right" if verdict == "unknown_at" else "silent" if verdict in QUIET else "wrong"
    if case.kind in ("null", "decoy"):
        quiet = verdict in QUIET or bool(named | grouped) and named | grouped <= truth
        return "right" if quiet else "unknown" if verdict == "unknown_at" else "wrong"
    if case.kind == "hidden" and (verdict in QUIET or truth & set(diagnosis["absorbed"])):
        return "right"
    if verdict in QUIET:
        return "silent"
    if verdict == "unknown_at":
        return "unknown"
    return _naming(truth, named, grouped, diagnosis["groups"])


def _naming(truth, named, grouped, groups):
    if named == truth and not grouped:
        return "right"
    if truth <= named | grouped:
        foreign = (named - truth) or len(groups) + len(named) > len(truth)
        return "extra" if foreign else "group"
    if truth & (named | grouped):
        return "partly"
    return "kin" if len(truth) == 1 and named and named <= kin(next(iter(truth))) else "wrong"


def read(suite: str, out: Path):
    """(case, diagnosis or None, done) of every case that is done: from the runner's folder or from a file of --keep."""
    for name, done, diagnosis in _kept(Path(out)) if Path(out).is_file() else _folders(suite, Path(out)):
        if name.rpartition("-")[0] != suite:
            raise SystemExit(f"{out}: holds {name}, which is no case of {suite}; give the rows of one suite")
        if done["status"] != GENERATOR_FAILED:  # a bench that could not be made says nothing
            yield make_case(suite, int(name.rpartition("-")[2])), diagnosis, done


def read_all(suite: str, outs) -> list:
    """The rows of several folders and files; a case that stands in two is refused: it would count twice."""
    found = {}
    for out in outs:
        for row in read(suite, out):
            other = found.setdefault(row[0].name, (out, row))[0]
            if other is not out:
                raise SystemExit(f"{row[0].name} stands in {other} and in {out}; give one of them")
    return [row for _, row in found.values()]


def _folders(suite, out):
    for k in range(size(suite)):
        folder = out / f"{suite}-{k:03d}"
        if (folder / "done.json").exists():
            path = folder / "result" / "diagnosis.json"
            yield (
                folder.name,
                json.loads((folder / "done.json").read_text()),
                json.loads(path.read_text()) if path.exists() else None,
            )


def _kept(path):
    for line in path.read_text().splitlines():
        row = json.loads(line)
        yield row["name"], row["done"], row["diagnosis"]


SCORED = ("coil.R_eddy", "mechanics.xi", "mechanics.f0")


def kept_line(name: str, done: dict, diagnosis) -> str:
    """A case's row of --keep: what the score reads of it, figures rounded to six digits."""
    row = {"name": name, "done": {k: done[k] for k in ("status", "seconds", "peak_MB") if k in done}, "diagnosis": None}
    if diagnosis:
        fits = {}
        for key in ("base", "repaired"):
            fitted = diagnosis.get(key)
            known = (
                {n: {k: p.get(k) for k in ("value", "stderr")} for n, p in fitted.get("parameters", {}).items() if n in SCORED}
                if fitted
                else {}
            )
            fits[key] = {"chi2_per_sample": fitted["chi2_per_sample"], "parameters": known} if fitted else None
        row["diagnosis"] = {
            "verdict": diagnosis["verdict"], "groups": diagnosis["groups"], "absorbed": diagnosis["absorbed"],
            "effects": [{k: e[k] for k in ("name", "confidence")} for e in diagnosis["effects"]],
            "unknown": {"block": (diagnosis["unknown"] or {}).get("block")},
            "check": [{k: c[k] for k in ("rms_before", "rms_after", "noise_rms")} for c in diagnosis["check"]], **fits,
        }  # fmt: skip
    return json.dumps(_rounded(row))


def _rounded(value):
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    return [_rounded(v) for v in value] if isinstance(value, list) else value


def gap_closed(diagnosis):
    """Shares of the gap between the base's check error and the noise that the repair closed."""
    for c in diagnosis["check"]:
        gap = c["rms_before"] ** 2 - c["noise_rms"] ** 2
        if c["rms_before"] > 1.5 * c["noise_rms"] > 0:
            yield 1 - max(c["rms_after"] ** 2 - c["noise_rms"] ** 2, 0.0) / gap


def coverage(case, diagnosis):
    """Whether each 90 % interval of R_eddy, xi and f0 holds the truth."""
    fitted = (diagnosis.get("repaired") or diagnosis.get("base") or {}).get("parameters", {})
    for key in SCORED:
        p, true = fitted.get(key), case.truth[key.split(".")[1]]
        if p and p.get("stderr"):
            yield abs(p["value"] - true) <= 1.645 * p["stderr"]


def table(suite: str, rows) -> str:
    """The result table, the confusion matrix and the numbers beside them."""
    by, closed, covered, seconds, memory, blocks = {}, [], [], [], [], []
    for case, diagnosis, done in rows:
        outcome = judge(case, diagnosis, done["status"])
        by.setdefault((case.kind, case.level if case.kind in ("single", "outside", "hidden") else ""), []).append(outcome)
        seconds.append(done["seconds"])
        memory += [done["peak_MB"]] if "peak_MB" in done else []
        if diagnosis and case.kind in ("single", "pair"):
            closed += gap_closed(diagnosis)
        if diagnosis and (case.kind == "null" or outcome == "right" and case.kind in ("single", "pair")):
            covered += coverage(case, diagnosis)
        if diagnosis and case.kind == "outside" and outcome == "right":
            blocks.append((diagnosis["unknown"] or {}).get("block") == block_outside(case))
    used = [o for o in ORDER if any(o in v for v in by.values())]
    lines = [f"Suite {suite}: {len(rows)} of {size(suite)} cases run, labels {seal(suite)[:16]}.", ""]
    lines += ["| concealed | cases | " + " | ".join(used) + " | right or group, 95 % |", "|---|" + "---|" * (len(used) + 2)]
    rank = ("null", "decoy", "single", "pair", "outside", "hidden", "data")
    for key in sorted(by, key=lambda k: (rank.index(k[0]), ("weak", "mid", "strong", "").index(k[1]))):
        got = by[key]
        cells = " | ".join(str(got.count(o) or "") for o in used)
        lines.append(f"| {' '.join(filter(None, key))} | {len(got)} | {cells} | {_share(got)} |")
    lines.append("")
    if closed:
        lines.append(f"Gap of the check error to the noise closed (power, median of {len(closed)}): {np.median(closed):.0%}.")
    if covered:
        low, high = wilson(sum(covered), len(covered))
        lines.append(
            f"90 % intervals of R_eddy, xi, f0 hold the truth in {np.mean(covered):.0%} ({low:.0%} to {high:.0%}, {len(covered)})."
        )
    lines += _foretold(rows)
    if blocks:
        lines.append(f"unknown_at names the right block in {sum(blocks)} of {len(blocks)}.")
    lines.append(f"Time of one diagnosis, compilation included: median {np.median(seconds):.0f} s, longest {max(seconds):.0f} s.")
    if memory:
        lines.append(f"Its peak memory ({len(memory)} cases): median {np.median(memory):.0f} MB, highest {max(memory)} MB.")
    return "\n".join([*lines, *_believed(rows), *_by_sight(rows)]) + "\n\n" + confusion(rows)


def _foretold(rows) -> list[str]:
    """Error on check recordings after the diagnosis in units of their noise, where nothing outside the catalogue acts."""
    lines = []
    for title, kinds in (("nulls", ("null", "decoy", "hidden")), ("one effect or two", ("single", "pair"))):
        ratios = [
            c["rms_after"] / c["noise_rms"] for case, d, _ in rows if d and case.kind in kinds for c in d["check"] if c["noise_rms"]
        ]
        if ratios:
            middle, high = np.quantile(ratios, (0.5, 0.9))
            lines.append(
                f"Check error after the diagnosis over the noise, {title}: median {middle:.2f}, nine tenths below {high:.2f} ({len(ratios)})."
            )
    return lines


def _believed(rows) -> list[str]:
    """Whether a stated confidence means what it says: share of the named effects that are concealed, by confidence."""
    bands = {"below 0.6": [], "0.6 to 0.9": [], "0.9 to 0.98": [], "above 0.98": []}
    for case, diagnosis, _ in rows:
        for effect in diagnosis["effects"] if diagnosis else ():
            band = next(b for b, top in zip(bands, (0.6, 0.9, 0.98, 1.1), strict=True) if effect["confidence"] < top)
            bands[band].append((effect["name"] in case.effects, effect["confidence"]))
    if not any(bands.values()):
        return []
    lines = ["", "| stated confidence | named | mean stated | truly concealed, 95 % |", "|---|---|---|---|"]
    for band, got in bands.items():
        if got:
            true = sum(t for t, _ in got)
            low, high = wilson(true, len(got))
            lines.append(
                f"| {band} | {len(got)} | {np.mean([c for _, c in got]):.2f} | {true}/{len(got)}: {low:.0%} to {high:.0%} |"
            )
    return lines


SEEN = 10.0  # an oracle's z from which the targets of the proof ask for a name
APART = 5.0  # and its z beyond the nearest rival, from which they ask for the one name


def _by_sight(rows):
    """Singles, and pairs by the lesser of the two, by what the oracle could see; singles by what it sees beyond their nearest rival."""
    seen, left = (json.loads(file.read_text()) if file.exists() else {} for file in (ORACLE, RIVALS))
    named = ("right", "group")
    return [
        *_banded("single, oracle z", "single", seen, rows, named, f"singles of z = {SEEN:g} or more: right or in a group", SEEN),
        *_banded("pair, lesser oracle z", "pair", seen, rows, named, f"pairs of z = {SEEN:g} or more: right or in a group", SEEN),
        *_banded(
            "single, z beyond the nearest rival",
            "single",
            left,
            rows,
            ("right",),
            f"singles of z = {APART:g} or more beyond their nearest rival: exactly named",
            APART,
        ),
    ]


def _banded(title, kind, sight, rows, as_good, said, least):
    """A table of outcomes by the least z that `sight` tells of a case, and the share that is as good as is asked for from `least` on."""
    known = [
        (min(sight[c.name].values()), judge(c, d, done["status"])) for c, d, done in rows if c.kind == kind and c.name in sight
    ]
    if not known:
        return []
    lines = ["", f"| {title} | cases | right | group | kin | silent | other | {' or '.join(as_good)}, 95 % |", "|---|" + "---|" * 7]
    for low, high in itertools.pairwise((0.0, 5.0, 10.0, 30.0, 100.0, np.inf)):
        if got := [outcome for z, outcome in known if low <= z < high]:
            n = [got.count(w) for w in ("right", "group", "kin", "silent")]
            cells = " | ".join(map(str, [*n, len(got) - sum(n)]))
            band = f"{low:g} to {high:g}" if np.isfinite(high) else f"above {low:g}"
            lines.append(f"| {band} | {len(got)} | {cells} | {_share(got, as_good)} |")
    if got := [outcome for z, outcome in known if z >= least]:
        lines += ["", f"Seen by the oracle, {said} {_share(got, as_good)}."]
    return lines


def _share(outcomes, as_good=("right", "group")) -> str:
    """How many are as good as is asked for, with its interval."""
    good = sum(o in as_good for o in outcomes)
    low, high = wilson(good, len(outcomes))
    return f"{good}/{len(outcomes)}: {low:.0%} to {high:.0%}"


def confusion(rows) -> str:
    """What was said for each single and outside effect, as a list: truth -> verdicts."""
    said = {}
    for case, diagnosis, done in rows:
        if case.kind in ("single", "outside", "hidden"):
            said.setdefault((case.kind, next(iter(case.effects))), Counter())[_spoken(diagnosis, done)] += 1
    lines = ["| concealed | said (times) |", "|---|---|"]
    for (kind, name), counter in sorted(said.items()):
        said_as = ", ".join(f"{s} ({n})" for s, n in counter.most_common())
        lines.append(f"| {name}{'' if kind == 'single' else f' ({kind})'} | {said_as} |")
    return "\n".join(lines)


def _spoken(diagnosis, done):
    if diagnosis is None:
        return f"exit {done['status']}"
    parts = [e["name"] for e in diagnosis["effects"]] + ["{" + " ".join(g) + "}" for g in diagnosis["groups"]]
    unknown = f"unknown_at {(diagnosis['unknown'] or {}).get('block')}"
    return " + ".join(parts) or (unknown if diagnosis["verdict"] == "unknown_at" else diagnosis["verdict"])


def main():
    """Print the table and, with --cases, every case; with --table also write it."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("suite", choices=list(SUITES))
    p.add_argument("--out", type=Path, nargs="+", default=[Path("blind-results")], help="folder of the runner, or files of --keep")
    p.add_argument("--cases", action="store_true")
    p.add_argument("--table", type=Path)
    p.add_argument("--keep", type=Path)
    options = p.parse_args()
    rows = read_all(options.suite, options.out)
    if not rows:
        raise SystemExit(
            f"no finished case of {options.suite} in {options.out[0]}: run python -m tests.blind.run {options.suite} first"
        )
    for case, diagnosis, done in rows if options.cases else ():
        chi = [round((diagnosis[k] or {}).get("chi2_per_sample") or np.nan, 2) for k in ("base", "repaired")] if diagnosis else ""
        ratio = [round(c["rms_after"] / max(c["noise_rms"], 1e-12), 2) for c in diagnosis["check"]] if diagnosis else ""
        words = (
            case.name,
            case.kind,
            case.level,
            case.effects,
            case.density,
            case.start,
            "->",
            judge(case, diagnosis, done["status"]),
        )
        print(*words, "|", _spoken(diagnosis, done), chi, ratio, done["seconds"], "s", flush=True)
    text = table(options.suite, rows)
    print(text)
    if options.keep:
        options.keep.write_text("".join(kept_line(c.name, done, d) + "\n" for c, d, done in rows))
    if options.table:
        options.table.write_text(text + "\n")


if __name__ == "__main__":
    main()
