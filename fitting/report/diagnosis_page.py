"""The page of a diagnosis: the verdict in plain words first, what to do next, and then the grounds for it."""

import json
import math
import re

from . import found as pictures
from . import learned, loops, misfit, plane, tables
from .banner import headline, spoken, tone
from .fit_page import AT_NOISE, DEFINED, FAR, bounds_of, convergence_part, headed, residual_section, sentence, validity
from .page import Sketch, part, section
from .residuals import repeating
from .style import percent, plain, scale_of, terms_in, unit_text, words

RUN_PLACEBO = "To run it: magjax diagnose of these recordings with --placebo 20."
HERE = re.compile(r"; run magjax diagnose on the same files| \(magjax diagnose tells which\)")  # a fit's advice, followed here
FRAMED = (
    "The framed block need not be the darkest. The shades are of single effects of the catalogue, to first order; the frame stands where a "
    "smooth function that was fitted jointly with all else foretells recordings left out best, or, of those that foretell them about as well, "
    "where the rest of the model hides it least."
)
SEEN_AT = 5.0  # smallest_visible is seen at so many standard deviations


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
        _named(found, facts),
        _groups(found, facts),
        _unknown(found, sketch),
        section("Next experiment", *_next(found, names)),
        section("The signal at fault", sketch(evidence.get("offender"), loops.offender, evidence.get("offender"))),
        section(
            "The recordings as they are",
            part(table=None if fit else tables.as_recorded(evidence.get("recordings"))),
            sketch(evidence.get("recordings"), loops.periods, evidence.get("recordings")),
        ),
        _checks(found, evidence, sketch, output, drive),
        _where(found, facts, base, repaired, sketch, output, drive),
        _ranking(found, facts, sketch),
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


def _doubt(fit) -> str:
    """What is wrong with the standard errors of a fit, "" where nothing is or there is none."""
    return validity(fit)[3] if fit else ""


def _named(found, facts):
    if not found["effects"]:
        return None
    doubt = _doubt(found["repaired"])
    rows, laws = [], []
    for e in found["effects"]:
        rows.append([words(e["name"]), e["block"], _size(e["parameters"]), plain(e["confidence"], 2)])
        about = facts.get(e["name"], {})
        if about.get("law"):
            laws.append(f"{words(e['name'])}: {about['law']}. How it shows: {about['signature']}. Source: {about['source']}.")
    note = "Confidence: probability of the effect among those that were fitted, times the share of the excess misfit that it takes."
    return section(
        "What was left out",
        part(
            table=tables.table(
                "Effects found", ["effect", "block", f"size (± {doubt})" if doubt else "size", "confidence"], rows, note
            )
        ),
        part(bullets=laws),
    )


def _size(parameters) -> str:
    """Parameters with their errors; what was given has none."""

    def one(p):
        if p.get("given"):
            return " ".join(filter(None, (plain(p["value"], 4), unit_text(p["unit"]), "(given)")))
        return f"{tables.to_error(p['value'], p['stderr'])} ± {plain(p['stderr'], 2)} {unit_text(p['unit'])}".strip()

    return "; ".join(f"{n} = {one(p)}" for n, p in parameters.items())


def _groups(found, facts):
    if not found["groups"]:
        return None
    rows, ties = [], found.get("ties", {})
    for number, group in enumerate(found["groups"], 1):
        for place, name in enumerate(group, 1):
            about = facts.get(name, {})
            size = _size(found.get("rivals", {}).get(name, {}))
            row = [words(name), number, place, about.get("block", ""), size]
            tie = ties.get(name, {"chi2_per_sample": None, "why": ""})
            why = tie["why"] or ("the best" if name in ties else "")
            row += [plain(tie["chi2_per_sample"]), said_of(why)] if ties else []
            rows.append([*row, about.get("signature", "")])
    left = (found["repaired"] or {}).get("chi2_per_sample") or 0.0
    whole = found["verdict"] != "unknown_at" and left < FAR  # else something is left that none of them explains
    does = "Each of these repairs the model" if whole else "Each of these takes the same part of the misfit"
    text = f"{does}, and to name one from these recordings would be a guess."
    text += " Why each is not told from the best stands beside it; χ²/N is that of a fit with it." if ties else ""
    head = [
        "rival",
        "group",
        "rank in its group",
        "block",
        "size, were it this",
        *(("χ²/N", "why it is in the group") if ties else ()),
        "how it shows",
    ]
    return section(
        "Not told apart by these recordings", part(text=text, table=tables.table("Rivals, most likely first", head, rows))
    )


def said_of(text: str) -> str:
    """A phrase of the search in the signs of the page."""
    return text.replace("chi2", "χ²")


def _unknown(found, sketch):
    unknown = found["unknown"]
    if not unknown:
        return None
    rows = [["block it acts most like", unknown.get("block", "")], ["region", unknown.get("region", "")]]
    if "explained_share" in unknown:
        rows.append(["share of the excess that the nearest effect explains", percent(unknown["explained_share"])])
    more = {} if "function" in unknown else unknown
    rows += [
        [words(k), _shown(v)]
        for k, v in more.items()
        if k not in ("block", "region", "explained_share") and isinstance(v, (str, int, float))
    ]
    known = part(table=tables.table("The unknown", ["question", "answer"], rows))
    return section("What is known of it", known, *learned.parts(unknown, sketch))


def _next(found, names):
    ask = found["next_experiment"]
    if not ask:
        return []
    parts = [part(text=sentence(spoken(ask["text"], names)))]
    channels = [c for c in ask.get("channels", []) if c]
    told = all(c in ask["text"] for c in channels)
    parts.append(None if told else part(text=f"Channels to record: {'; '.join(channels)}."))
    rows = [[words(a), words(b), plain(p, 2)] for a, b, p in ask.get("separates", [])]
    parts.append(
        part(table=tables.table("What it separates", ["effect", "from", "probability of the right name"], rows)) if rows else None
    )
    return parts


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


def power(candidate, facts) -> str:
    """Probability that these recordings would show the effect at the top of its typical range."""
    typical = facts.get(candidate["name"], {}).get("typical")
    visible = candidate["smallest_visible"]
    if not typical or not visible or tried_at(candidate) is not None or not math.isfinite(visible):
        return "–"
    z = SEEN_AT * typical / visible
    return percent(0.5 * (1 + math.erf((z - pictures.THRESHOLD) / math.sqrt(2))))


def tried_at(candidate) -> float | None:
    """The finite amplitude at which a candidate was scored, None where its score is to first order."""
    same = candidate["amplitude"] == candidate["smallest_visible"]  # so it was stored before it was told
    return candidate.get("tried_at", candidate["amplitude"] if same else None)


def _ranking(found, facts, sketch):
    ranked = sorted(
        (c for c in found["candidates"] if math.isfinite(c["z"] if c["z"] is not None else math.nan)), key=lambda c: -abs(c["z"])
    )
    if not ranked:
        return None
    rows = []
    for c in ranked:
        unit = f" {unit_text(facts.get(c['name'], {}).get('unit', ''))}".rstrip()
        drop = c["achieved_chi2_drop"]
        fell = "not fitted" if drop is None else plain(drop) if drop >= 0 else f"rose by {plain(-drop)}"
        strong = "–" if c["name"] in found["absorbed"] else power(c, facts)
        bic = plain(c["bic_change"]) if c["bic_change"] is not None else ""
        finite = tried_at(c)
        size = f"{plain(c['amplitude'])}{unit}" if finite is None else f"tried at {plain(finite)}{unit}"
        seen = f"{plain(c['smallest_visible'])}{unit}" if finite is None else "–"
        rows.append([words(c["name"]), facts.get(c["name"], {}).get("block", ""), plain(c["z"]), plain(c["visibility"], 2), size, seen, strong,
                     plain(c["predicted_chi2_drop"]), fell, bic])  # fmt: skip
    head = [
        "effect",
        "block",
        "z",
        "visibility",
        "amplitude, first order",
        "visible from",
        "power",
        "χ² fall, predicted",
        "achieved",
        "change of BIC",
    ]
    note = (
        "z: score in standard deviations. Visibility: what share of its mark the base model cannot imitate. Visible from: amplitude seen at five "
        "standard deviations. Power: probability that these recordings would show the effect at the top of its typical range. Achieved: what "
        "a fit with the effect took, that of an adopted one as it ended, on a density that may be finer by then than its rivals'; where χ² rose, "
        "the fit did not settle."
    )
    if any(tried_at(c) is not None for c in ranked):
        note += (
            " Tried at: scored at this amplitude, for it has no mark to first order; from where it would be visible is not known."
        )
    if any(c["z"] == 0 and c["amplitude"] < 0 for c in ranked):
        note += " A z of 0 beside an amplitude below 0: the misfit asks for the sign that the effect cannot have."
    absorbed = ", ".join(words(n) for n in found["absorbed"])
    text = f"These recordings could not show {absorbed}: the density imitates them." if absorbed else ""
    drawn = sketch(ranked, pictures.ranking, ranked)
    return section(
        "The catalogue against the misfit",
        drawn,
        part(table=tables.table("Every candidate, best first", head, rows, note)),
        part(text=text),
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


def placebo_section(placebo, verdict):
    """How often the search cries wolf on recordings that lack nothing; or that this was not tried, and how to."""
    title = "Placebo"
    if not placebo:
        if verdict == "data_problem":
            return None
        text = (
            "Not tried. The final model is simulated on the same drives with fresh noise, those recordings are searched as the measured ones "
            "were, and it is counted how often the search adopts an effect though nothing more is there."
        )
        return section(title, part(text=text), part(text=RUN_PLACEBO))
    number, false, table = placebo["runs"], placebo["false_alarms"], "The same search on recordings that lack nothing"
    low, high = interval(false, number)
    share = f"({percent(false / number)}; 95 % interval {percent(low)} to {percent(high)})"
    if placebo.get("procedure") == "search":
        scored = placebo["screening_alarms"]
        text = (
            f"In {false} of {number} sets of recordings simulated from the final model the same search adopted an effect, where nothing more "
            f"was {share}. In {scored} of them something scored above the threshold of the screening and was fitted beside its rivals; in the "
            "others the search ended there by its own rule."
        )
    else:  # a folder written when the screening alone was repeated
        table = "The screening of recordings that lack nothing"
        text = (
            f"In {false} of {number} sets of recordings simulated from the final model something scored above the threshold, where nothing more "
            f"was {share}. Only the screening was repeated: an alarm names nothing yet."
        )
    rows = [[words(str(k)), _shown(v)] for k, v in placebo.items()]
    return section(title, part(text=text), part(table=tables.table(table, ["quantity", "value"], rows)))


def _shown(value) -> str:
    if isinstance(value, dict):
        return "; ".join(f"{words(str(k))}: {_shown(v)}" for k, v in value.items()) or "none"
    if isinstance(value, (list, tuple)):
        return ", ".join(_shown(v) for v in value) or "none"
    return plain(value, 4) if isinstance(value, float) else str(value)


def interval(hits: int, number: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    z, p = 1.96, hits / number
    centre, half = p + z * z / (2 * number), z * math.sqrt(p * (1 - p) / number + z * z / (4 * number**2))
    scale = 1 + z * z / number
    return max(0.0, (centre - half) / scale), min(1.0, (centre + half) / scale)


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
            sketch(best, plane.mass_map, best, doubt=_doubt(repaired)),
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
