"""The investigation: record, fit, diagnose, record what the diagnosis asks for, until the verdict is settled or the budget is spent.

Fit and diagnosis come in as `analyse(recording files, check files, step) -> the content of diagnosis.json`, so that this module knows
neither JAX nor the fitting package. Everything is in investigation.json after every step: a second call goes on where the first ended.
"""

import dataclasses
import html
import json
import time
from pathlib import Path

from ..errors import ConfigurationError
from .campaign import FEWEST, Campaign, Entry, Plan, entries, sine_entry
from .source_check import check_source

SETTLED = ("attributed", "nothing_missing")
# fractions of the current limit: what a first study holds, what checks it, what is tried where the diagnosis asks for nothing
STUDY = ((10, 0.88, 0.11), (20, 0.55, -0.22), (50, 0.88, 0.11), (100, 0.55, -0.22), (200, 0.88, 0.11), (300, 0.55, 0.0))
CHECKS = ((400, 0.66, 0.05), (150, 0.77, 0.0))
FURTHER = ((350, 0.77, 0.0), (30, 0.4, 0.3), (250, 0.7, -0.1), (70, 0.9, 0.0), (5, 0.7, 0.1), (120, 0.3, -0.4))


@dataclasses.dataclass(frozen=True)
class Budget:
    """What may be spent: recordings and minutes, over all calls."""

    recordings: int = 20
    minutes: float = 30.0

    def __post_init__(self):
        if self.recordings < 2 or not 0 < self.minutes < float("inf"):
            raise ConfigurationError(f"--recordings {self.recordings} --minutes {self.minutes:g}: give two or more, and some time")


class Investigation:
    """One investigation in the campaign's folder. `plan`: a `Plan` for the first study, None for the usual one."""

    def __init__(self, campaign: Campaign, analyse, budget: Budget, plan: Plan | None = None, clock=time.monotonic):
        self.campaign, self.analyse, self.budget, self.plan, self.clock = campaign, analyse, budget, plan, clock
        self.path = campaign.folder / "investigation.json"
        self.state = {"bench": campaign.bench.name, "extra": [], "steps": [], "spent_s": 0.0}
        if self.path.exists():
            try:
                self.state = json.loads(self.path.read_text(encoding="utf-8"))
                about, _ = self.state["bench"], [self.state[k] for k in ("extra", "steps", "spent_s")]
            except (ValueError, KeyError, TypeError, OSError) as error:
                raise ConfigurationError(
                    f"{self.path}: cannot be read ({error}); remove it to begin anew, the recordings are kept"
                ) from None
            if about != campaign.bench.name:
                raise ConfigurationError(f"{self.path} is about bench {about}; give another --out for {campaign.bench.name}")

    def run(self) -> dict:
        """Go on until it is settled or the budget is spent; the content of investigation.json."""
        begin, before = self.clock(), self.state["spent_s"]
        self.state.pop("ended", None)
        first, checks = self._first_entries()
        while True:
            extra = [self._entry(*drive, f"x{k:02d}") for k, drive in enumerate(self.state["extra"])]
            rows = self.campaign.run(self._affordable([*first, *checks, *extra]))
            files = {r["name"]: r["file"] for r in rows if not r["problems"]}
            self.state["recordings"] = rows
            self.state["spent_s"] = before + self.clock() - begin
            stopped = next((r for r in rows if r["status"] in (5, 130)), None)
            if stopped:
                if stopped["status"] == 130:
                    return self._end("interrupted", "What was recorded is kept; the same command goes on where it ended.")
                return self._end("device", stopped["problems"][0])
            if not any(e.name in files for e in [*first, *extra]):
                why = next((r["problems"][0] for r in rows if r["problems"]), "the budget leaves no recording")
                return self._end("no usable recording", f"Nothing fit to use was recorded: {why}.")
            step = self._step(
                [files[e.name] for e in [*first, *extra] if e.name in files], [files[e.name] for e in checks if e.name in files]
            )
            self.state["spent_s"] = before + self.clock() - begin
            if step["settled"]:
                return self._end("settled", step["message"])
            if len(rows) >= self.budget.recordings or self.state["spent_s"] > 60 * self.budget.minutes:
                spent = f"{len(rows)} of {self.budget.recordings} recordings, {self.state['spent_s'] / 60:.1f} of {self.budget.minutes:g} minutes"
                return self._end("budget spent", f"{step['message']} The budget is spent: {spent}.")
            drive = self._next_drive(step)
            if drive is None:
                return self._end(
                    "nothing left to try", f"{step['message']} No further experiment within the limits is left to try."
                )
            self.state["extra"].append(drive)
            step["asked_for"] = f"{drive[1]:.3g} A at {drive[0]:g} Hz about {drive[2]:.3g} A"
            self.campaign.say(f"next experiment: {step['asked_for']}")
            self._save()

    def _first_entries(self) -> tuple[list[Entry], list[Entry]]:
        rate = self.campaign.rate_max()
        self.rate_max = rate
        if self.plan is not None:
            first = entries(self.plan, rate)
        else:
            first = [self._entry(*drive, f"{k:03d}") for k, drive in enumerate(self._drives(STUDY))]
        checks = [self._entry(*drive, f"check{k}") for k, drive in enumerate(self._drives(CHECKS))]
        return [e for e in first if e.frequency], checks

    def _drives(self, usual):
        """(Hz, A, A) of the usual drives, their frequencies lowered by one factor where the device does not sample the fastest."""
        fastest = FEWEST * max(f for f, *_ in (*STUDY, *CHECKS))
        share = min(1.0, (1 - 1e-9) * self.rate_max / fastest)  # a hair less: that many samples a period must fit
        return [(f * share, a * self._limit, o * self._limit) for f, a, o in usual]

    @property
    def _limit(self) -> float:
        if not self.campaign.limit:
            raise ConfigurationError("the bench states no current limit; write limits.current_A in its file, or give --limit")
        return float(self.campaign.limit)

    def _entry(self, frequency, amplitude, offset, mark) -> Entry:
        entry = sine_entry(frequency, round(amplitude, 4), round(offset, 4), self.campaign.settings, self.rate_max)
        return dataclasses.replace(entry, name=f"{mark}_{entry.name}")

    def _affordable(self, wanted):
        return wanted[: self.budget.recordings]

    def _step(self, files, checks) -> dict:
        """Fit and diagnose all recordings so far; kept from an earlier call where the files are the same."""
        key = sorted(Path(f).name for f in files)
        for step in self.state["steps"]:
            if step["files"] == key:
                return step
        number = len(self.state["steps"])
        self.campaign.say(f"diagnosis {number + 1}: {len(files)} recordings, {len(checks)} checks")
        content = self.analyse(files, checks, number)
        source = check_source([*files, *checks])
        step = {
            "files": key,
            "checks": [Path(f).name for f in checks],
            "diagnosis": f"diagnosis_{number + 1}",
            "source": source,
            **judge(content, source),
        }
        step["next_experiment"] = content.get("next_experiment")
        self.state["steps"].append(step)
        self._save()
        return step

    def _next_drive(self, step):
        """(Hz, A, A): what the diagnosis asks for, else the next of the usual ones; never the same twice."""
        asked = (step.get("next_experiment") or {}).get("drive")
        menu = [(asked["frequency_Hz"], asked["amplitude"], asked["offset"])] if asked else []
        menu += [(f, a * self._limit, o * self._limit) for f, a, o in FURTHER]
        done = [(d[0], d[1], d[2]) for d in self.state["extra"]]
        done += self._drives(STUDY) if self.plan is None else []
        for f, a, o in menu:
            a = min(a, self._limit - abs(o))
            near = any(
                abs(f / g - 1) < 0.02 and abs(a - b) < 0.05 * self._limit and abs(o - c) < 0.05 * self._limit for g, b, c in done
            )
            if a > 0 and not near and f * FEWEST <= self.rate_max:
                return [float(f), float(round(a, 4)), float(round(o, 4))]
        return None

    def _end(self, how, message) -> dict:
        last = self.state["steps"][-1] if self.state["steps"] else {}
        self.state["ended"] = {"how": how, "message": message, "verdict": last.get("verdict"), "effects": last.get("effects", [])}
        self._save()
        return self.state

    def _save(self):
        partial = self.path.with_name("investigation.json.part")
        partial.write_text(json.dumps(self.state, indent=1), encoding="utf-8")
        partial.replace(self.path)
        (self.campaign.folder / "report.html").write_text(page(self.state), encoding="utf-8")


def judge(content: dict, source: dict | None) -> dict:
    """What a diagnosis and the source's own check say together: verdict, effects with who decided them, settled, message."""
    effects = [{**e, "decided_by": deciders(content)} for e in content["effects"]]
    verdict, message = content["verdict"], content["message"]
    if any(e["name"] == "amplifier_lag" for e in effects):  # the diagnosis has judged the source from the same recordings
        names = [Path(d["file"]).name for d in (source or {}).get("decided_by", [])[:3]]
        effects = [{**e, "decided_by": names or e["decided_by"]} if e["name"] == "amplifier_lag" else e for e in effects]
    elif source and source["verdict"] == "amplifier_lag":
        tau = {"value": source["tau"], "stderr": source["stderr"], "unit": "s"}
        names = [Path(d["file"]).name for d in source["decided_by"][:3]]
        effects.append(
            {
                "name": "amplifier_lag",
                "block": "source",
                "parameters": {"tau": tau},
                "confidence": 0.99,
                "shifts": {},
                "decided_by": names,
            }
        )
        message += f" The measured current lags its command by {1e6 * tau['value']:.3g} us as a first-order amplifier does: amplifier_lag (source)."
        verdict = "attributed" if verdict == "nothing_missing" else verdict
    elif source and source["verdict"] != "follows" and "Between command and measured current" not in message:
        message += f" Between command and measured current stands something else than a first-order lag ({source['verdict']})."
    checks = [r for r in content.get("check", []) if r["noise_rms"] > 0]
    foretold = all(r["rms_after"] < 3 * r["noise_rms"] for r in checks)
    if not foretold:
        message += " The check recordings are not foretold to three times their noise."
    for effect in effects:
        message += f" {effect['name']} was decided by {', '.join(effect['decided_by'])}."
    return {
        "verdict": verdict,
        "effects": effects,
        "groups": content["groups"],
        "settled": verdict in SETTLED and foretold and content.get("ended_after") is None,
        "message": message,
    }


def deciders(content: dict) -> list[str]:
    """The recordings whose misfit falls most by the repair, most first, until nine tenths of the fall are named."""
    base, repaired = content.get("base") or {}, content.get("repaired") or {}
    before = {Path(r["file"]).name: r["chi2_per_sample"] for r in base.get("recordings", [])}
    fall = {
        Path(r["file"]).name: before.get(Path(r["file"]).name, 0.0) - r["chi2_per_sample"] for r in repaired.get("recordings", [])
    }
    total, named, share = sum(max(v, 0.0) for v in fall.values()), [], 0.0
    for name, value in sorted(fall.items(), key=lambda pair: -pair[1]):
        if share >= 0.9 * total or value <= 0:
            break
        named.append(name)
        share += value
    return named


def page(state: dict) -> str:
    """report.html of an investigation: every step, with links to its diagnosis."""
    say = html.escape
    rows = ["<!doctype html><html lang=en><meta charset=utf-8><title>Investigation</title>",
            "<style>body{font:16px/1.5 sans-serif;max-width:50em;margin:2em auto;padding:0 1em}td,th{padding:.2em .8em;text-align:left}</style>",
            f"<h1>Investigation of {say(state['bench'])}</h1>"]  # fmt: skip
    if "ended" in state:
        rows.append(f"<p><b>{say(state['ended']['how'])}.</b> {say(state['ended']['message'])}</p>")
    for k, step in enumerate(state["steps"]):
        rows.append(f"<h2>Step {k + 1}: {say(step['verdict'])}</h2><p>{say(step['message'])}</p>")
        rows.append(f'<p><a href="{step["diagnosis"]}/report.html">diagnosis</a> of {say(", ".join(step["files"]))}</p>')
        if step["source"]:
            s = step["source"]
            rows.append(
                f"<p>Source by command and shunt: {say(s['verdict'])}, tau = {s['tau']:.4g} s (standard error {s['stderr']:.2g} s).</p>"
            )
        if "asked_for" in step:
            rows.append(f"<p>Next experiment: {say(step['asked_for'])}</p>")
    rows.append("<h2>Recordings</h2><table><tr><th>name<th>drive<th>tries<th>verdict</tr>")
    for r in state.get("recordings", []):
        rows.append(
            f"<tr><td>{say(r['name'])}<td>{say(r['text'])}<td>{r['tries']}<td>{say('; '.join(r['problems']) or 'good')}</tr>"
        )
    return "\n".join([*rows, "</table></html>"])
