"""Build report.html from the JSON of a result folder and its figures; nothing else is needed, so it can be rebuilt."""

import json
import re
from pathlib import Path

from magjax.errors import ConfigurationError

from ..result import write_atomically, write_model
from . import figures

ALT = {
    "loops": "Measured (solid) and fitted (dashed) loops for each recording, with the difference over one period below.",
    "loops_after": "The same with the repaired model.",
    "masses": "Identified Preisach masses over the plane; cells that no recording switches are hatched.",
    "misfit": "Squared misfit over noise for each recording and harmonic, before any repair.",
    "paper_loops": "Displacement against current at seven frequencies for two ranges of current, with the paper's constants.",
    "lag_table": "Damping ratio from the phase lag against frequency, one line for each R_eddy of the mesh; the picked one is bold.",
    "ranking": "Scores of the catalogue's effects on the misfit of the plain model.",
}


def write_fit(folder: Path, result, recordings, content: dict, reproduce: str) -> None:
    """Write fit.json, model.json, figures and report.html of a fit."""
    folder = Path(folder)
    content = {**content, "reproduce": reproduce}
    write_atomically(folder / "fit.json", json.dumps(content, indent=1))
    write_model(folder, result.actuator, result.bench)
    shapes = _figure_folder(folder)
    figures.loops(result, shapes)
    figures.mass_map(result, shapes)
    figures.misfit_map(result, shapes)
    rebuild(folder)


def write_diagnosis(folder: Path, diagnosis, recordings, content: dict, reproduce: str) -> None:
    """Write diagnosis.json, the repaired model, figures and report.html of a diagnosis."""
    folder = Path(folder)
    content = {**content, "reproduce": reproduce}
    write_atomically(folder / "diagnosis.json", json.dumps(content, indent=1))
    shapes = _figure_folder(folder)
    best = diagnosis.repaired or diagnosis.base
    if best is not None:
        write_model(folder, best.actuator, best.bench)
        figures.misfit_map(diagnosis.base, shapes)
        figures.loops(diagnosis.base, shapes, title="before: plain model")
        figures.mass_map(best, shapes)
    if diagnosis.candidates:
        figures.ranking(diagnosis, shapes)
    if diagnosis.repaired is not None:
        figures.loops(diagnosis.repaired, shapes, "loops_after", "after: repaired model")
    rebuild(folder)


def _figure_folder(folder):
    shapes = folder / "figures"
    shapes.mkdir(exist_ok=True)
    return shapes


def rebuild(folder: Path) -> Path:
    """Build report.html of a result folder again from its JSON and figures."""
    folder = Path(folder)
    for name in ("diagnosis", "fit"):
        path = folder / f"{name}.json"
        if path.exists():
            content = json.loads(path.read_text(encoding="utf-8"))
            break
    else:
        raise ConfigurationError(f"{folder}: holds no fit.json or diagnosis.json; give a folder that magjax fit or diagnose wrote")
    page = _diagnosis_page(content, folder) if name == "diagnosis" else _fit_page(content, folder)
    return render(folder / "report.html", page, content.get("reproduce", ""))


def render(target: Path, page: dict, reproduce: str) -> Path:
    """Write one page from its sections."""
    from jinja2 import Environment

    template = Environment(autoescape=True).from_string((Path(__file__).parent / "page.html").read_text(encoding="utf-8"))
    write_atomically(target, template.render(**page, reproduce=reproduce))
    return target


def inline(folder, stem):
    """The figure of that stem as inline SVG with its alternative text, empty where it was not drawn."""
    path = folder / "figures" / f"{stem}.svg"
    if not path.exists():
        return {}
    svg = path.read_text(encoding="utf-8")
    svg = svg[svg.index("<svg") :]
    # matplotlib reuses ids: make them unique to this figure within the page
    svg = re.sub(r'\bid="', f'id="{stem}-', svg)
    svg = re.sub(r'(xlink:href="#|url\(#)', rf"\g<1>{stem}-", svg)
    return {"figure": svg, "alt": ALT[stem]}


def _g(value, digits=4):
    return "" if value is None else f"{value:.{digits}g}"


def _parameter_table(fit):
    rows = []
    for name, p in fit["parameters"].items():
        flags = ", ".join(f for f, on in (("at bound", p["at_bound"]), ("not identified", not p["identified"]), ("fixed", not p["free"])) if on)
        spread = 1.96 * p["stderr"]
        interval = f"{_g(p['value'] - spread, 6)} .. {_g(p['value'] + spread, 6)}" if p["free"] else ""
        rows.append([name, _g(p.get("start")), _g(p["value"], 6), _g(p["stderr"], 2) if p["free"] else "", interval, p["unit"], flags])
    return {"head": ["parameter", "start", "value", "std. error", "95 % interval", "unit", ""], "rows": rows}


def _recording_table(fit):
    rows = [
        [Path(r["file"]).name, _g(r["frequency"]), r["periods"], _g(r["noise_rms"], 3), _g(r["residual_rms"], 3), _g(r["chi2_per_sample"], 3)]
        for r in fit["recordings"]
    ]
    return {"head": ["recording", "f / Hz", "periods", "noise rms", "residual rms", "chi2/N"], "rows": rows}


def _tone(fit):
    if not fit["converged"] or fit["chi2_per_sample"] > 2:
        return "bad"
    return "" if fit["chi2_per_sample"] < 1.15 else "warn"


def _fit_page(fit, folder):
    sections = [
        {"title": "Parameters", "table": _parameter_table(fit)},
        {"title": "Recordings", "table": _recording_table(fit)},
        {"title": "Loops", **inline(folder, "loops")},
        {"title": "Where the misfit sits", **inline(folder, "misfit")},
        {"title": "Density", **inline(folder, "masses")},
        {"title": "Correlations", "table": {"head": ["pair", "correlation"], "rows": [[k, _g(v, 3)] for k, v in fit["correlations"].items()]}},
    ]
    if fit.get("check"):
        rows = [[Path(r["file"]).name, _g(r["rms_after"], 3), _g(r["noise_rms"], 3), r["unit"]] for r in fit["check"]]
        sections.insert(2, {"title": "Check recordings", "table": {"head": ["recording", "rms error", "noise", "unit"], "rows": rows}})
    headline = f"chi2/N = {fit['chi2_per_sample']:.3g}"
    return {"title": "Joint fit", "bench": fit["bench"], "tone": _tone(fit), "headline": headline, "message": fit["message"], "sections": sections}


def _diagnosis_page(found, folder):
    sections = []
    if found["check"]:
        rows = [[Path(r["file"]).name, _g(r["rms_before"], 3), _g(r["rms_after"], 3), _g(r["noise_rms"], 3), r["unit"]] for r in found["check"]]
        sections.append({"title": "Check recordings", "table": {"head": ["recording", "before", "after", "noise", "unit"], "rows": rows}})
    if found["effects"]:
        rows = [
            [e["name"], e["block"], ", ".join(f"{n} = {_g(p['value'])} ± {_g(p['stderr'], 2)} {p['unit']}" for n, p in e["parameters"].items()), _g(e["confidence"], 2)]
            for e in found["effects"]
        ]
        sections.append({"title": "What was left out", "table": {"head": ["effect", "block", "size", "confidence"], "rows": rows}})
        shifts = [[n, _g(b, 6), _g(a, 6)] for e in found["effects"] for n, (b, a) in e["shifts"].items()]
        if shifts:
            text = "What the plain model had got wrong to compensate."
            sections.append({"title": "Parameter shifts", "text": text, "table": {"head": ["parameter", "before", "after"], "rows": shifts}})
    if found["groups"]:
        rows = [[" or ".join(g)] for g in found["groups"]]
        sections.append({"title": "Not told apart by these recordings", "table": {"head": ["rivals, most likely first"], "rows": rows}})
    if found["next_experiment"]:
        sections.append({"title": "Next experiment", "text": found["next_experiment"]["text"]})
    sections.append({"title": "Where", **inline(folder, "misfit")})
    ranked = [
        [c["name"], _g(c["z"], 3), _g(c["visibility"], 2), _g(c["amplitude"], 3), _g(c["smallest_visible"], 3), _g(c["achieved_chi2_drop"])]
        for c in found["candidates"]
    ]
    head = ["effect", "z", "visibility", "amplitude", "visible from", "chi2 gained"]
    sections.append({"title": "Ranking", **inline(folder, "ranking"), "table": {"head": head, "rows": ranked}})
    sections.append({"title": "Before", **inline(folder, "loops")})
    sections.append({"title": "After", **inline(folder, "loops_after")})
    if found["floors"]:
        rows = [[k, _g(v, 3)] for k, v in found["floors"].items()]
        sections.append({"title": "Floors", "table": {"head": ["floor", "rms"], "rows": rows}})
    for key, title in (("base", "Plain model"), ("repaired", "Repaired model")):
        if found[key]:
            sections.append({"title": title, "text": found[key]["message"], "table": _parameter_table(found[key])})
    tone = {"nothing_missing": "", "attributed": "warn", "group": "warn"}.get(found["verdict"], "bad")
    bench = found["base"]["bench"] if found["base"] else ""
    kept = [s for s in sections if s.get("table") or s.get("figure") or s.get("text")]
    return {"title": "Diagnosis", "bench": bench, "tone": tone, "headline": found["verdict"].replace("_", " "), "message": found["message"], "sections": kept}
