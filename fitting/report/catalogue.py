"""The catalogue against the misfit: what each candidate scored, from where on it would be seen, and what fits with it achieved."""

import math

from . import found as pictures
from . import tables
from .page import part, section
from .style import percent, plain, unit_text, words

SEEN_AT = 5.0  # smallest_visible is seen at so many standard deviations


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


def ranking(found, facts, sketch):
    """Every candidate of the catalogue against the misfit, best first."""
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
