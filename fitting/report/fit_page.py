"""The page of a fit: may it be trusted, what came out, how it meets each recording, what it leaves, what it holds inside."""

import json
import re
from pathlib import Path

from . import loops, misfit, plane, tables
from .page import Sketch, part, section
from .style import plain, terms_in

DEFINED = (
    "χ²/N: the squared misfit of each harmonic of the reading over the variance of its noise, mean over all N numbers. It is 1 where only noise is "
    "left; its root says how many times its noise the misfit is that repeats every period."
)
MICRO = re.compile(r"(?<=\d) u(?=[msAVT]\b)")
BELOW_NOISE, AT_NOISE, FAR = 0.5, 1.1, 2.0  # chi2/N: noise overstated; the error bars hold; they mean nothing
WORST_AT_NOISE = 1.6
FEWEST_STEPS = 3  # that make a picture of how the fit went
WORD = re.compile(r"""(?:'[^']*'|"[^"]*"|[^\s'"])+""")  # of a command line
FIT_ALONE = ("--cells", "--bootstrap", "--bootstrap-kind", "--profile", "--workers", "--scheduler", "--checkpoint")


def validity(fit) -> tuple[str, str, str, str]:
    """(tone, headline, advice, doubt about the error bars) of a fit; the doubt is a key of `tables.DOUBTS`."""
    chi2 = fit["chi2_per_sample"]
    bound = [n for n, p in fit["parameters"].items() if p["at_bound"]]
    loose = [n for n, p in fit["parameters"].items() if p["free"] and not p["identified"] and not n.startswith(tables.LEARNED)]
    worst = max(fit["recordings"], key=lambda r: r["chi2_per_sample"], default={"chi2_per_sample": chi2})
    ask = "Run the diagnosis on the same files; it says what physics is missing, and where."
    if not fit["converged"]:
        mend = "The options for it: --max-jacobians and --model."
        return "bad", "Not converged: these numbers are not a result", mend, "not valid"
    if chi2 is None or chi2 != chi2:
        mend = "Check the signs and units of the channels in the bench file."
        return "bad", "The misfit is not a number: these numbers are not a result", mend, "not valid"
    if chi2 > FAR:
        return "bad", f"Error bars not valid: what repeats is {plain(chi2**0.5, 2)} times its noise", ask, "not valid"
    if bound:
        mend = "A parameter at its bound takes the blame for something else; free another, or check the bench file."
        return "bad", f"At a bound: {', '.join(bound)}", mend, "not valid"
    if chi2 > AT_NOISE or worst["chi2_per_sample"] > WORST_AT_NOISE:
        where, size = ("", chi2) if chi2 > AT_NOISE else (f" in {Path(worst['file']).name}", worst["chi2_per_sample"])
        return "warn", f"A little above the noise{where} (χ²/N = {plain(size)}): error bars are too narrow", ask, "too narrow"
    if loose:
        mend = "These recordings do not determine it; record another range, or hold it fixed."
        return "warn", f"At the noise, but not identified: {', '.join(loose)}", mend, ""
    if chi2 < BELOW_NOISE:
        mend = "The noise or the converters' errors that were assumed are larger than those in the recordings."
        return "good", f"Below the noise that was assumed (χ²/N = {plain(chi2)}): the error bars are on the safe side", mend, ""
    return "good", f"At the noise (χ²/N = {plain(chi2)}): the error bars hold", "", ""


def fit_page(fit, evidence, say=lambda text: None) -> dict:
    """The page's words, tables and pictures; `say(text)` before each picture."""
    tone, headline, advice, doubt = validity(fit)
    output, drive = _quantities(fit, evidence)
    sketch = Sketch(say)
    number = len(fit["recordings"])
    span = sorted(r["frequency"] for r in fit["recordings"])
    sections = [
        section(
            "Parameters",
            *(part(table=t) for t in (*tables.parameters(fit, doubt, bounds=bounds_of(evidence)), *tables.intervals(fit))),
            part(table=tables.correlations(fit)),
        ),
        section("Recordings", part(table=tables.recordings(fit, evidence))),
        section(
            "Measured and fitted",
            part(heading="Check recordings", table=tables.checks(fit["check"], repaired=False)) if fit.get("check") else None,
            sketch(evidence.get("checks"), loops.checks, evidence.get("checks"), output, drive, fit.get("check"), False),
            *headed("Loops", sketch(evidence, loops.loops, evidence, output, drive)),
            *headed("Zoom in time", sketch(evidence, loops.zoom, evidence, output)),
        ),
        residual_section(sketch, evidence, output),
        section(
            "The Preisach plane", part(text=plane.told(evidence, fit)), sketch(evidence, plane.mass_map, evidence, doubt=doubt)
        ),
        section("Inside the model", sketch(evidence.get("inside"), loops.inside, evidence, drive)),
        section("How the fit went", convergence_part(sketch, fit), part(table=tables.numbers(fit))),
    ]
    command = diagnose_command(fit.get("reproduce", "")) if "diagnosis" in advice else ""
    if "magjax diagnose" in fit["message"]:  # it is said
        advice = ""
    facts = f"Bench {fit['bench']}; {number} recording{'s' if number != 1 else ''}, {plain(span[0], 4)} to {plain(span[-1], 4)} Hz."
    return {
        "title": f"Joint fit of {fit['bench']}", "facts": facts, "tone": tone, "headline": headline, "message": [sentence(fit["message"])], "defined": DEFINED,
        "advice": advice, "command": command, "sections": [s for s in sections if s],
    }  # fmt: skip


def diagnose_command(reproduce: str) -> str:
    """The diagnosis of the same files into a folder of its own, from the command of a fit; "" where there is none.

    What only a fit can be asked for is left out.
    """
    words = WORD.findall(reproduce)
    if words[:2] != ["magjax", "fit"] or "--fleet" in words:
        return ""
    said, before = ["magjax", "diagnose"], ""
    for word in words[2:]:
        option, _, value = word.partition("=")
        if before == "--out":
            word = _beside(word)
        elif option == "--out" and value:
            word = f"--out={_beside(value)}"
        if before not in FIT_ALONE and option not in FIT_ALONE:
            said.append(word)
        before = word
    return " ".join(said)


def _beside(folder: str) -> str:
    """A folder beside that of the fit, quoted as it was."""
    quote = folder[-1] if folder[-1] in "'\"" else ""
    return f"{folder.removesuffix(quote).rstrip('/')}-diagnosis{quote}"


def bounds_of(evidence) -> dict:
    """What values the parameters can have: name -> (lowest, highest); {} where the evidence does not hold it."""
    return json.loads(str(evidence["bounds"])) if "bounds" in evidence else {}


def residual_section(sketch, evidence, output, title: str = "What the fit leaves", with_map: bool = True):
    """Map, traces, branches, autocorrelation and spectrum of the residual."""
    return section(
        title,
        *headed("By frequency and harmonic", sketch(evidence if with_map else None, misfit.misfit_map, evidence)),
        *headed("Along time", sketch(evidence, misfit.traces, evidence)),
        *headed(f"Against {terms_in(evidence).field}, rate and frequency", sketch(evidence, misfit.against, evidence)),
        *headed("Autocorrelation", sketch(evidence, misfit.autocorrelation, evidence)),
        *headed("Spectrum", sketch(evidence, misfit.spectrum, evidence, output)),
    )


def headed(heading, drawn) -> list:
    """A part under its heading, nothing where there is no part."""
    return [{"heading": heading, **drawn}] if drawn else []


def convergence_part(sketch, fit):
    """How the objective fell, where the fit kept it."""
    steps = [s for s in fit.get("history", []) if s[2] is not None and s[2] > 0]
    return sketch(steps if len(steps) >= FEWEST_STEPS else None, misfit.convergence, steps)


def sentence(text: str) -> str:
    """A message with a capital (unless it begins with a name) and a full stop, its signs as people write them."""
    text = re.sub(r"(?<=\d)%", "\u00a0%", text)
    text = text.strip().replace(" -> ", " → ").replace("chi2/N", "χ²/N").replace("= nan", "= not a number")
    if not text:
        return ""
    text = MICRO.sub(" µ", text)
    first = text.split()[0].rstrip(",:;.")
    return (text[0].upper() + text[1:] if first.isalpha() else text) + ("" if text.endswith((".", "?", "!")) else ".")


def _quantities(fit, evidence):
    """(output, drive) of the recordings."""
    unit = fit["recordings"][0]["unit"] if fit["recordings"] else "m"
    drive = str(evidence.get("drive", "current"))
    channel = fit["recordings"][0]["channel"] if fit["recordings"] else "displacement"
    return channel if channel in tables.CHANNEL_OF.values() else tables.CHANNEL_OF.get(unit, "displacement"), drive


def doubt_of(fit) -> str:
    """What is wrong with the standard errors of a fit, "" where nothing is or there is none."""
    return validity(fit)[3] if fit else ""
