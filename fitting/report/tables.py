"""The tables of the reports: numbers to the digits that their errors allow, flags in words."""

import math
import re
from pathlib import Path

import numpy as np

from ..reach import beyond_text
from .residuals import repeating, strokes
from .style import plain, scale_of, unit_text

LEARNED = "effects.learned_term."  # its function is drawn: its coefficients say nothing one by one
CHANNEL_OF = {"m": "displacement", "T": "flux_density", "A/m": "magnetization", "C/m^2": "polarization"}


def table(caption, head, rows, note: str = "", code: bool = False) -> dict:
    """A table for the template: the first cell of each row is its header, set as code where it is a name to type; columns of
    numbers are set to the right."""
    rows = [[str(c) for c in row] for row in rows]
    right = [k > 0 and name != "answer" and _of_numbers([row[k] for row in rows]) for k, name in enumerate(head)]
    return {"caption": caption, "head": list(head), "rows": rows, "right": right, "note": note, "code": code}


NUMBER = re.compile(r"(?:[<>+−] ?)?(?:\d[\d.]*(?:e−?\d+)?|∞)(?: [^\d→]{1,12}| 1/\w+)?|–|not fitted")
NUMBERS = 0.6  # share of the cells that makes a column one of numbers


def _of_numbers(cells) -> bool:
    """Whether a column holds numbers, units with them."""
    filled = [c for c in cells if c]
    return bool(filled) and sum(bool(NUMBER.fullmatch(c)) for c in filled) >= NUMBERS * len(filled)


def aligned(rows, least: int = 0) -> list[list[str]]:
    """Numbers that stand beside each other to the same decimals, three digits of the largest, `least` at least; each as it is
    where they differ by far."""
    sizes = [abs(v) for row in rows for v in row if v is not None and math.isfinite(v) and v != 0]
    if not sizes or not 1e-3 <= max(sizes) < 1e5 or max(sizes) > FAR_APART * min(sizes):
        return [[plain(v) for v in row] for row in rows]
    decimals = max(least, 2 - math.floor(math.log10(max(sizes))))
    write = lambda v: "–" if v is None or not math.isfinite(v) else f"{v:.{decimals}f}".replace("-", "−")
    return [[write(v) for v in row] for row in rows]


FAR_APART = 1e3


def to_error(value: float, error: float) -> str:
    """A value to the second digit of its error."""
    if not (error > 0 and math.isfinite(error)) or value == 0:
        return plain(value, 6)
    digits = max(1, int(math.floor(math.log10(abs(value)))) - int(math.floor(math.log10(error))) + 2) if abs(value) > error else 2
    return plain(value, min(digits, 10))


def flags(p, doubt: str = "") -> str:
    """Whether one estimate is identified, with the doubt about the error that says so."""
    said = [("at bound", p["at_bound"]), ("no", not p["identified"])]
    sure = "yes" + (f" (errors {doubt})" if doubt else "")
    return ", ".join(text for text, on in said if on) or (sure if p["free"] else "")


REPEATING = (
    "Rms all. Noise and residual of a sample are those of the readings as recorded; the repeating misfit is what of the residual comes back every "
    "period, in the harmonics, where averaging leaves less noise."
)
DOUBTS = {
    "": "",
    "not valid": "Standard errors assume that only noise is left. It is not, so the true errors are larger by an unknown amount.",
    "too narrow": "Standard errors assume that only noise is left. A little more is, so the true errors are somewhat larger.",
}


def interval(p, low: float = -math.inf, high: float = math.inf) -> str:
    """The 95 % interval of an estimate that cannot leave `low` to `high`."""
    ends = p["value"] - 1.96 * p["stderr"], p["value"] + 1.96 * p["stderr"]
    said = [f"{plain(bound)} (bound)" if beyond else to_error(end, p["stderr"])
            for end, bound, beyond in ((ends[0], low, ends[0] < low), (ends[1], high, ends[1] > high))]  # fmt: skip
    return " to ".join(said)


def parameters(fit, doubt: str = "", caption: str = "Fitted parameters", bounds=None) -> list[dict]:
    """Two tables: fitted parameters with errors and flags, and those held fixed; `doubt`: a key of DOUBTS; `bounds`: name ->
    (lowest, highest)."""
    free, fixed = [], []
    for name, p in fit["parameters"].items():
        if name.startswith(LEARNED):
            continue
        if not p["free"]:
            fixed.append([name, p.get("meaning", ""), plain(p["value"], 6), unit_text(p["unit"])])
            continue
        row = [
            name,
            p.get("meaning", ""),
            plain(p.get("start"), 5),
            to_error(p["value"], p["stderr"]),
            plain(p["stderr"], 2),
            interval(p, *(bounds or {}).get(name, ())),
            unit_text(p["unit"]),
            flags(p, doubt),
        ]
        free.append(row)
    error, span = (f"{name} ({doubt})" if doubt else name for name in ("std. error", "95 % interval"))
    tables = []
    if free:
        tables.append(
            table(
                caption,
                ["parameter", "meaning", "start", "value", error, span, "unit", "identified?"],
                free,
                DOUBTS[doubt],
                code=True,
            )
        )
    if fixed:
        tables.append(table("Held at the bench file's values", ["parameter", "meaning", "value", "unit"], fixed, code=True))
    return tables


def correlations(fit) -> dict | None:
    """The correlation matrix of the fitted constants, those beyond 0.9 marked; None with less than two constants."""
    pairs = fit["correlations"]
    names = [n for n in dict.fromkeys(n for pair in pairs for n in pair.split("~")) if not n.startswith(LEARNED)]
    if len(names) < 2:
        return None
    rows = []
    for a in names:
        row = [a]
        for b in names:
            value = 1.0 if a == b else pairs.get(f"{a}~{b}", pairs.get(f"{b}~{a}"))
            strong = a != b and value is not None and abs(value) > 0.9
            row.append("" if value is None else f"{value:.2f}".replace("-", "−") + (" strong" if strong else ""))
        rows.append(row)
    note = (
        "“strong” marks pairs beyond 0.9: their values move together, and neither is known as well alone."
        if any("strong" in c for r in rows for c in r)
        else ""
    )
    return table("Correlations of the fitted constants", ["", *names], rows, note, code=True)


def recordings(fit, evidence=None) -> dict:
    """Every recording with its noise and its misfit; with the `evidence` of the fit also what of the misfit repeats."""
    rows = []
    known = bool(evidence) and len(evidence["name"]) == len(fit["recordings"])
    repeats = list(zip(*repeating(evidence), strokes(evidence), strict=True)) if known else []
    units = [scale_of(CHANNEL_OF.get(r["unit"], "displacement"))[2:] for r in fit["recordings"]]
    samples = aligned(
        [[fine * r[k] for k in ("noise_rms", "residual_rms")] for r, (fine, _) in zip(fit["recordings"], units, strict=True)]
    )
    sizes = aligned([[fine * v for v in row[:2]] for row, (fine, _) in zip(repeats, units, strict=False)])
    shares = aligned([[100 * misfit / stroke if stroke > 0 else None] for misfit, _, stroke in repeats])
    chi2 = aligned([[r["chi2_per_sample"]] for r in fit["recordings"]], least=2)
    for k, r in enumerate(fit["recordings"]):
        unit = units[k][1]
        more = [*(f"{v} {unit}" for v in sizes[k]), _with_percent(shares[k][0])] if known else []
        rows.append([Path(r["file"]).name, plain(r["frequency"], 4), r["periods"], *(f"{v} {unit}" for v in samples[k]), *more, *chi2[k],
                     r["sha256"][:12]])  # fmt: skip
    more = ["repeating misfit", "its noise", "of the stroke"] if known else []
    head = ["recording", "frequency / Hz", "periods", "noise of a sample", "residual of a sample", *more, "χ²/N", "sha256 begins"]
    note = REPEATING if known else ""
    if not any(row[-1] for row in rows):  # recordings that were never files
        head, rows = head[:-1], [row[:-1] for row in rows]
    return table("Noise and misfit of each recording", head, rows, note, code=True)


def as_recorded(entries) -> dict | None:
    """What can be said of recordings that no fit has seen; `entries`: as `evidence.of_recordings` keeps them."""
    rows = []
    for e in (entries or {}).values():
        factor, unit = (1e6, "µm") if str(e["output"]) == "displacement" else scale_of(str(e["output"]))[2:]
        frequency = f"{plain(float(e['frequency']), 4)} Hz" if e["frequency"] else "does not repeat"
        rows.append([str(e["name"]), frequency, int(max(e["number"])), f"{plain(factor * float(np.ptp(e['reading'])))} {unit}"])
    return (
        table("Recordings that can be read", ["recording", "frequency", "periods", "peak to peak"], rows, code=True)
        if rows
        else None
    )


def _with_percent(number: str) -> str:
    return number if number == "–" else f"{number} %"


def before_and_after(base, repaired, found) -> dict | None:
    """What each recording leaves before and after a repair; `found`: the evidence of both, where it is kept. None without both."""
    pairs = list(zip(base["recordings"], repaired["recordings"], strict=False)) if base and repaired else []
    if not pairs or [Path(a["file"]).name for a, _ in pairs] != [Path(b["file"]).name for _, b in pairs]:
        return None
    known = all(len(e.get("name", ())) == len(pairs) for e in found)
    fine, unit = scale_of(CHANNEL_OF.get(base["recordings"][0]["unit"], "displacement"))[2:]
    samples = aligned([[fine * a["noise_rms"], fine * a["residual_rms"], fine * b["residual_rms"]] for a, b in pairs])
    repeats = aligned((fine * np.stack([repeating(e)[0] for e in found], axis=1)).tolist()) if known else [[]] * len(pairs)
    chi2 = aligned([[r["chi2_per_sample"] for r in pair] for pair in pairs], least=2)
    rows = []
    for (a, _), sample, repeat, worth in zip(pairs, samples, repeats, chi2, strict=True):
        rows.append([Path(a["file"]).name, *(f"{v} {unit}" for v in (*sample, *repeat)), *worth])
    more = ["repeating misfit before", "after"] if known else []
    head = ["recording", "noise of a sample", "residual of a sample before", "after", *more, "χ²/N before", "after"]
    return table("Misfit of each recording, before and after", head, rows, REPEATING if known else "", code=True)


def checks(rows, repaired: bool = True) -> dict:
    """Prediction errors on recordings that took no part."""
    keys, units, numbers = ("rms_before", "rms_after") if repaired else ("rms_after",), [], []
    told = any(r.get("expected_rms") for r in rows)
    for r in rows:
        fine, unit = scale_of(CHANNEL_OF.get(r["unit"], "displacement"))[2:]
        beyond = [(max(r[k] ** 2 - r["noise_rms"] ** 2, 0.0)) ** 0.5 for k in keys]
        more = [r.get("expected_rms") or float("nan")] if told else []
        numbers.append([fine * v for v in (*(r[k] for k in keys), *more, r["noise_rms"], *beyond)])
        units.append(unit)
    body = [[Path(r["file"]).name, *texts, unit] for r, texts, unit in zip(rows, aligned(numbers), units, strict=True)]
    when = (" before", " after") if repaired else ("",)
    expected = ["expected"] if told else []
    head = ["recording", *(f"rms error{w}" for w in when), *expected, "noise rms", *(f"beyond noise{w}" for w in when), "unit"]
    note = "Beyond noise: √(rms error² − noise rms²), 0 where the error is the smaller. "
    note += "Expected: the noise and what the last model does not know of its parameters and of the cells that the drive switches. " if told else ""
    note = f"{note}{beyond_text(rows)}".strip()
    return table("Errors of prediction", head, body, note, code=True)


def intervals(fit) -> list[dict]:
    """Intervals by resampling and by profile likelihood, where the fit was asked for them."""
    made = []
    boot, profile = fit.get("bootstrap"), fit.get("profile")
    if boot:
        rows = [[n, to_error(p["low"], p["deviation"]), to_error(p["high"], p["deviation"]), plain(p["deviation"], 2), plain(p["stderr"], 2),
                 unit_text(p["unit"])] for n, p in boot["parameters"].items()]  # fmt: skip
        caption = (
            f"Bootstrap ({boot['kind']}), {boot['settled']} of {boot['draws']} draws settled: {100 * boot['level']:g} % intervals"
        )
        made.append(
            table(caption, ["parameter", "from", "to", "deviation of the draws", "std. error of the fit", "unit"], rows, code=True)
        )
    if profile:
        rows = [[n, to_error(p["low"], p["stderr"]) + ("" if p["low_found"] else " (not closed)"),
                 to_error(p["high"], p["stderr"]) + ("" if p["high_found"] else " (not closed)"), unit_text(p["unit"])]
                for n, p in profile["parameters"].items()]  # fmt: skip
        made.append(
            table(
                f"Profile likelihood: {100 * profile['level']:g} % intervals", ["parameter", "from", "to", "unit"], rows, code=True
            )
        )
    return made


def numbers(fit) -> dict:
    """Size and cost of the fit."""
    rows = [
        ["χ²/N", plain(fit["chi2_per_sample"], 4)],
        ["numbers met (real and imaginary parts of harmonics)", fit.get("data_count", "")],
    ]
    if fit.get("effective_unknowns") is not None:
        rows.append(["effective unknowns", plain(fit["effective_unknowns"], 3)])
    rows += [
        ["level L of the plane, edges included", fit["levels"]],
        ["BIC", plain(fit["bic"], 6)],
        ["Jacobians", fit["jacobians"]],
    ]
    rows += [["compilation / s", plain(fit["compile_s"], 2)], ["iteration / s", plain(fit["solve_s"], 2)]]
    return table("Size and cost of the fit", ["quantity", "value"], rows)
