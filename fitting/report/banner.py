"""The banner of a diagnosis: its verdict in plain words, and the colour that goes with it."""

import re
from pathlib import Path

from . import tables
from .fit_page import AT_NOISE, WORST_AT_NOISE
from .style import plain, scale_of, words

TONES = {
    "nothing_missing": "good",
    "attributed": "info",
    "group": "warn",
    "absorbed": "warn",
    "unknown_at": "warn",
    "data_problem": "bad",
}
FILE = re.compile(r"(?:^|[.] )((?:(?![.] )[^:])+?[.][A-Za-z]\w*): ")  # that an error begins with
FILES_TOO = re.compile(r" \(the same of ([^()]+)\)[.]")  # those that share it
FORETOLD = 1.4  # times its noise, up to which a check recording is foretold
AS_EXPECTED = 1.5  # times what the model expects its error to be


def spoken(text: str, names) -> str:
    """A text with the effects' `names` as people say them."""
    for name in sorted(names, key=len, reverse=True):
        text = text.replace(name, words(name))
    return text


def tone(found) -> str:
    """The colour of the banner: a silent verdict over a misfit, or of a search cut short, is a warning."""
    silent = found["verdict"] == "nothing_missing"
    return "warn" if silent and (still_left(found) or found.get("ended_after")) else TONES.get(found["verdict"], "bad")


def still_left(found) -> str:
    """What the plain model leaves above the noise of fitted and of check recordings, in words; "" where it is nothing."""
    said, base = [], found["base"] or {"chi2_per_sample": 0.0, "recordings": []}
    chi2, worst = base["chi2_per_sample"], max(base["recordings"], key=lambda r: r["chi2_per_sample"], default=None)
    if chi2 > AT_NOISE:
        said.append(f"a misfit of χ²/N = {plain(chi2)} is left")
    elif worst and worst["chi2_per_sample"] > WORST_AT_NOISE:
        said.append(f"{Path(worst['file']).name} is left with a misfit of χ²/N = {plain(worst['chi2_per_sample'])}")
    missed = [r for r in found["check"] if r["noise_rms"] and r["rms_after"] > FORETOLD * r["noise_rms"]]
    if missed:
        r = max(missed, key=lambda r: r["rms_after"] / r["noise_rms"])
        fine, unit = scale_of(tables.CHANNEL_OF.get(r["unit"], "displacement"))[2:]
        noise = f"noise {plain(fine * r['noise_rms'])} {unit}"
        if r["rms_after"] < AS_EXPECTED * (r.get("expected_rms") or 0.0):
            noise += f"; about as expected, {plain(fine * r['expected_rms'])} {unit}: the recordings tell little of the cells that it switches"
        said.append(f"a check recording is missed by {plain(fine * r['rms_after'])} {unit} ({noise})")
    return " and ".join(said)


def headline(found) -> str:
    """The verdict in plain words, and whether a limit of time left something out."""
    return _headline(found) + ("; the limit of time came before all was tried" if found.get("ended_after") else "")


def _headline(found) -> str:
    verdict = found["verdict"]
    if verdict == "attributed":
        names = " and ".join(f"{words(e['name'])} ({e['block']})" for e in found["effects"])
        return f"Found what the model leaves out: {names}"
    if verdict == "group":
        names = "; ".join(" or ".join(words(n) for n in g) for g in found["groups"])
        return f"Something is missing, and these recordings cannot say which: {names}{_beside(found)}"
    if verdict == "nothing_missing" and (left := still_left(found)):
        return f"No effect {_asked(found)} was found{_judged(found)}; {left}"
    if verdict == "nothing_missing" and found.get("ended_after"):
        return f"No effect {_asked(found)} was found"
    if verdict == "unknown_at":
        where = found["unknown"]["block"] if found["unknown"] else "an unknown block"
        return f"Something is missing that no effect {_asked(found)} explains; it acts most like the block {where}{_beside(found, groups=True)}"
    return {
        "nothing_missing": "Nothing is missing: the model meets the recordings to their noise",
        "absorbed": "What may be missing cannot show in these recordings: the density absorbs it",
        "data_problem": f"{_at_fault(found)} must be mended first; no physics is judged",
    }.get(verdict, words(verdict))


def _beside(found, groups: bool = False) -> str:
    """The effects that were found beside what a headline is of, and, where asked for, the `groups`."""
    names = [f"{words(e['name'])} ({e['block']})" for e in found["effects"]]
    names += [" or ".join(map(words, g)) for g in found["groups"]] if groups else []
    return f"; found beside it: {', '.join(names)}" if names else ""


def _at_fault(found) -> str:
    """What a data problem asks to be mended."""
    text = f"{found['message']} {found['data_problem'] or ''}"
    bench = "[columns" in text or "bench file" in text
    files = [name for told in FILES_TOO.findall(text) for name in told.split(" and ")]
    files = list(dict.fromkeys(Path(name).name for name in (*FILE.findall(text), *files)))
    if bench and (files or "leave it out" in text):
        return "The recordings or the bench file"
    return "The bench file" if bench else " and ".join(files) or "The recordings"


def _asked(found) -> str:
    """Of which effects the diagnosis speaks."""
    return "asked for" if found.get("asked") else "of the catalogue"


def _judged(found) -> str:
    """How many effects could be judged: the density does not hide them."""
    number = len(found["candidates"])
    absorbed = {c["name"] for c in found["candidates"]} & set(found["absorbed"])
    return f" ({number - len(absorbed)} of {number} could be judged)" if number else ""
