"""The page of a diagnosis: the verdict in plain words first, what to do next, and then the grounds for it."""

import json
import math
import re

from . import found as pictures
from . import loops, misfit, plane, tables
from .banner import headline, spoken, tone
from .catalogue import ranking
from .fit_page import AT_NOISE, DEFINED, bounds_of, convergence_part, doubt_of, headed, residual_section, sentence, validity
from .named import groups, named, next_experiment, unknown_section
from .page import Sketch, part, section
from .placebo import placebo_section
from .residuals import repeating
from .style import plain, scale_of, terms_in, unit_text, words

HERE = re.compile(r"; run magjax diagnose on the same files| \(magjax diagnose tells which\)")  # a fit's advice, followed here
FRAMED = (
    "The framed block need not be the darkest. The shades are of single effects of the catalogue, to first order; the frame stands where a "
    "smooth function that was fitted jointly with all else foretells recordings left out best, or, of those that foretell them about as well, "
    "where the rest of the model hides it least."
)


def diagnosis_page(found, evidence, say=lambda text: None) -> dict:
    """The page's words, tables and pictures; `say(text)` before each picture."""
    sketch = Sketch(say)
    facts = json.loads(str(evidence["catalogue"])) if "catalogue" in evidence else {}
    base, repaired = evidence.get("base", {}), evidence.get("repaired", {})  # none where the recordings themselves are shown
    fit = found["base"] or {}
    output = (fit.get("recordings") or [{"channel": "displacement"}])[0]["channel"]
    broken = bool(fit) and not math.isfinite(fit["chi2_per_sample"] if fit["chi2_per_sample"] is not None else math.nan)
    drive = str(evidence.get("drive", "current"))
    names = {c["name"] for c in found["candidates"]} | set(facts)
    sections = [
        named(found, facts),
        groups(found, facts),
        unknown_section(found, sketch),
        section("Next experiment", *next_experiment(found, names)),
        section("The signal at fault", sketch(evidence.get("offender"), loops.offender, evidence.get("offender"))),
        section(
            "The recordings as they are",
            part(table=None if fit else tables.as_recorded(evidence.get("recordings"))),
            sketch(evidence.get("recordings"), loops.periods, evidence.get("recordings")),
        ),
        _checks(found, evidence, sketch, output, drive),
        _where(found, facts, base, repaired, sketch, output, drive),
        ranking(found, facts, sketch),
        _loops(found, base, repaired, sketch, output, drive),
        _left(found, base, repaired, sketch, output),
        _shifts(found),
        placebo_section(found.get("placebo"), "data_problem" if broken else found["verdict"]),
        *_models(found, evidence, sketch, drive),
        section("Floors", part(table=_floors(found, base, output))),
    ]
    count = len(fit.get("recordings", []))
    plural = lambda n, what: f"{n} {what}{'' if n == 1 else 's'}"
    name = fit["bench"] if fit else str(evidence.get("bench", ""))
    about = (
        f"Bench {name}; {plural(count, 'recording')}, {plural(len(found['check']), 'check recording')}."
        if fit
        else f"Bench {name}; no fit was tried."
        if name
        else "No fit was tried."
    )
    broken_down = "The fit broke down: its misfit is not a number. Check the signs and units of the channels in the bench file."
    told = sentence(spoken(found["message"], names))
    known = found["data_problem"] is not None  # the cause was found
    said = [told, broken_down] if broken and known else [broken_down] if broken else [told]
    return {
        "title": f"Diagnosis of {name}" if name else "Diagnosis", "facts": about, "tone": "bad" if broken else tone(found),
        "headline": "No verdict can be trusted: the fit broke down" if broken and not known else headline(found),
        "message": said, "defined": DEFINED if fit else "", "sections": [s for s in sections if s],
    }  # fmt: skip


def _checks(found, evidence, sketch, output, drive):
    rows = [r for r in found["check"] if not r.get("joined")]
    if not rows:
        return None
    repaired = bool(found["repaired"])
    checks = evidence.get("checks")
    drawn = sketch(checks, loops.checks, checks, output, drive, rows, repaired, added(found))
    title = "Check recordings, before and after" if repaired else "Check recordings"
    return section(title, part(table=tables.checks(rows, repaired)), drawn)


def added(found) -> str:
    """The effects that the repaired model holds beyond the plain one, in words."""
    held = [
        {n.split(".")[1]: 0 for n in (found[k] or {}).get("parameters", {}) if n.startswith("effects.")}
        for k in ("base", "repaired")
    ]
    return " and ".join(words(n) for n in held[1] if n not in held[0])


def _loops(found, base, repaired, sketch, output, drive):
    title = "Fitted recordings, before and after" if repaired else "Measured and fitted loops"
    return section(
        title,
        part(table=tables.before_and_after(found["base"], found["repaired"], (base, repaired))),
        sketch(base and base["chosen"].size, loops.loops, base, output, drive, repaired or None, added(found)),
    )


def _where(found, facts, base, repaired, sketch, output, drive):
    where = found["where"]
    if not where or not base:
        return None
    marks = {facts[n]["block"]: "a rival acts here" for g in found["groups"] for n in g if n in facts}
    marks |= {e["block"]: "effect named here" for e in found["effects"]}
    marks |= {found["unknown"]["block"]: "acts most like this"} if found["unknown"] else {}
    met = not marks and found["base"]["chi2_per_sample"] < AT_NOISE
    return section(
        "Where simulation and recordings differ",
        part(text=FRAMED if "function" in (found["unknown"] or {}) else ""),
        sketch(where.get("by_block"), pictures.block_map, where, marks, drive, met),
        *headed(
            "Misfit against the noise floor, by frequency and harmonic", sketch(base, misfit.misfit_map, base, beside=repaired)
        ),
        *headed(
            f"By branch, {terms_in(base).field} and period", sketch(where.get("by_branch"), pictures.places, where, base, output)
        ),
    )


def repair_words(found) -> str:
    """What to call the model with the additions of the search."""
    if "function" in (found["unknown"] or {}):
        return "the model with the learned function"
    return {"unknown_at": "the nearest repair tried", "group": "the model with the leading rival"}.get(
        found["verdict"], "the repaired model"
    )


def _left(found, base, repaired, sketch, output):
    if not repaired:
        return residual_section(sketch, base, output, "What the plain model leaves", with_map=False) if base else None
    return section(
        f"What {repair_words(found)} leaves",
        *headed(
            "By frequency and harmonic",
            sketch(repaired, misfit.misfit_map, repaired, "misfit-after", f"Misfit of {repair_words(found)} over noise", base),
        ),
        *headed(
            f"Against {terms_in(repaired).field}, rate and frequency", sketch(repaired, misfit.against, repaired, "against-after")
        ),
        *headed("Autocorrelation", sketch(repaired, misfit.autocorrelation, repaired, "autocorrelation-after")),
        *headed("Spectrum", sketch(repaired, misfit.spectrum, repaired, output, "spectrum-after")),
    )


def _shifts(found):
    after = (found["repaired"] or {}).get("parameters", {})
    shifts = {name: pair for e in found["effects"] for name, pair in e["shifts"].items()}
    if not shifts and found["verdict"] == "group" and found["base"]:  # those of the leading rival, which the repaired model holds
        before = {n: p["value"] for n, p in found["base"]["parameters"].items() if p["free"] and not n.startswith("effects.")}
        shifts = {n: [value, after[n]["value"]] for n, value in before.items() if n in after}
    rows = []
    for name, (before, now) in shifts.items():
        error = after.get(name, {}).get("stderr", 0.0)
        apart = plain(abs(now - before) / error, 2) if error else "–"
        share = f"{100 * (before - now) / abs(now):+.2g} %".replace("-", "−") if now else "–"
        unit = unit_text(after.get(name, {}).get("unit", ""))
        rows.append([name, tables.to_error(before, error), tables.to_error(now, error), unit, share, apart])
    if not rows:
        return None
    text = "To make up for what it lacked, the plain model had bent these constants; beside each, what it had got wrong."
    if found["verdict"] == "group":
        leading = " and ".join(words(g[0]) for g in found["groups"])
        text += f" So it is if the leading rival is right: {leading}."
    head = ["parameter", "before", "after", "unit", "was wrong by", "in standard errors"]
    return section(
        "Parameter shifts", part(text=text, table=tables.table("Constants before and after the repair", head, rows, code=True))
    )


def _models(found, evidence, sketch, drive):
    base, repaired = found["base"], found["repaired"]
    best = evidence.get("repaired") or evidence.get("base") or {}
    if repaired:
        yield section(
            sentence(repair_words(found)).rstrip("."),
            part(text=sentence(HERE.sub("", repaired["message"]))),
            *(
                part(table=t)
                for t in tables.parameters(repaired, validity(repaired)[3], f"Parameters of {repair_words(found)}", bounds_of(best))
            ),
            part(table=tables.correlations(repaired)),
            part(text=plane.told(best, repaired)),
            sketch(best, plane.mass_map, best, doubt=doubt_of(repaired)),
            sketch(best.get("inside"), loops.inside, best, drive),
            convergence_part(sketch, repaired),
        )
    if base:
        spoilt = found["verdict"] == "data_problem" or not math.isfinite(base["chi2_per_sample"])
        doubt = "not valid" if spoilt else validity(base)[3]
        plain_tables = tables.parameters(base, doubt, "Parameters of the plain model", bounds_of(evidence.get("base", {})))
        yield section(
            "A fit to them as they are (not to be used)" if spoilt else "The plain model",
            part(text=sentence("" if spoilt else HERE.sub("", base["message"]))),
            *(part(table=t) for t in plain_tables[: 1 if repaired else 2]),
            part(table=tables.recordings(base, evidence.get("base"))),
            *(
                []
                if repaired
                else [
                    part(text=plane.told(best, base)),
                    sketch(best, plane.mass_map, best, doubt=doubt),
                    sketch(best.get("inside"), loops.inside, best, drive),
                ]
            ),
        )


def _floors(found, base, output):
    fine, unit = scale_of(output)[2:]
    meaning = {
        "noise_rms": "noise of one sample, from what lies between the harmonics", "solver_rms": "change of the simulation when its step is halved",
        "density_rms": "what a smooth density may leave",
    }  # fmt: skip
    rows = [
        [meaning.get(k, words(k)), f"{plain(fine * v)} {unit}"] for k, v in found["floors"].items() if isinstance(v, (int, float))
    ]
    if base and rows:
        noise = float((repeating(base)[1] ** 2).mean() ** 0.5)
        rows.insert(1, ["noise of what repeats, in all harmonics of a recording", f"{plain(fine * noise)} {unit}"])
    return tables.table("The floors below which nothing is claimed", ["floor", "rms"], rows) if rows else None
