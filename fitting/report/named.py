"""What a verdict names, in tables: effects, groups of rivals, what no effect explains, and what to record next."""

from magjax.words import sized

from . import learned, tables
from .banner import spoken
from .fit_page import FAR, doubt_of, sentence
from .page import part, section
from .style import percent, plain, unit_text, words


def named(found, facts):
    """What was left out: the effects that stand alone, with their laws."""
    if not found["effects"]:
        return None
    doubt = doubt_of(found["repaired"])
    rows, laws = [], []
    for e in found["effects"]:
        rows.append([words(e["name"]), e["block"], size_of(e["parameters"]), plain(e["confidence"], 2)])
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


def size_of(parameters) -> str:
    """Parameters with their errors; what was given has none, and of what sits at its bound it does not hold."""

    def one(p):
        said = "(given)" if p.get("given") else "(at its bound)" if p.get("at_bound") else ""
        if said:
            return " ".join(filter(None, (plain(p["value"], 4), unit_text(p["unit"]), said)))
        return f"{tables.to_error(p['value'], p['stderr'])} ± {plain(p['stderr'], 2)} {unit_text(p['unit'])}".strip()

    return "; ".join(f"{n} = {one(p)}" for n, p in parameters.items())


def groups(found, facts):
    """What was left out where the recordings do not tell which: the rivals, and why."""
    if not found["groups"]:
        return None
    rows, ties = [], found.get("ties", {})
    for number, group in enumerate(found["groups"], 1):
        for place, name in enumerate(group, 1):
            about = facts.get(name, {})
            size = size_of(found.get("rivals", {}).get(name, {}))
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


def _alternation(unknown) -> list:
    """Rows on what differs from period to period."""
    size, error = (plain(100 * abs(unknown[k]), 3) for k in ("amplitude", "stderr"))
    return [
        ["size, of the motion", f"{size} ± {error} %"],
        ["rms of what alternates", sized(unknown.get("unit", "m"), unknown["rms"])],
        ["share of it that goes with the motion", percent(unknown["share"])],
    ]


def unknown_section(found, sketch):
    """What is known of that which no effect explains."""
    unknown = found["unknown"]
    if not unknown:
        return None
    rows = [["block it acts most like", unknown.get("block", "")], ["region", unknown.get("region", "")]]
    if "amplitude" in unknown:
        rows += _alternation(unknown)
    elif "explained_share" in unknown:
        rows.append(["share of the excess that the nearest effect explains", percent(unknown["explained_share"])])
    known = part(table=tables.table("The unknown", ["question", "answer"], rows))
    return section("What is known of it", known, *learned.parts(unknown, sketch))


def next_experiment(found, names):
    """The recording that would tell more: parts of a section."""
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
