"""From a result folder to report.html: one file, offline, without script. JSON and report.npz are all that it reads."""

import json
import re
import zipfile
from pathlib import Path

from magjax.errors import ConfigurationError

from ..result import write_atomically
from . import store

ALWAYS = ("chi2_per_sample", "bic", "effective_unknowns", "residual_rms")
TEMPLATE = Path(__file__).parent / "page.html"


def rebuild(folder: Path, progress=None) -> Path:
    """Build report.html of a result folder again from its JSON and its evidence.

    `progress(text)` is called before each figure. Raises `ConfigurationError` where the folder holds no result.
    """
    folder = Path(folder)
    written = [folder / f"{name}.json" for name in ("diagnosis", "fit") if (folder / f"{name}.json").exists()]
    if not written:
        raise ConfigurationError(f"{folder}: holds no fit.json or diagnosis.json; give a folder that magjax fit or diagnose wrote")
    path = max(written, key=lambda p: p.stat().st_mtime_ns)  # a fit may stand beside an earlier diagnosis
    content, name = _read(path), path.stem
    say = (lambda text: None) if progress is None else (lambda text: progress(f"report: {text}"))
    needed, again = ("base", "diagnose") if name == "diagnosis" else ("chi2_per_sample", "fit")
    if not isinstance(content, dict) or needed not in content:
        raise ConfigurationError(f"{path}: is no result (no {needed}); run magjax {again} again")
    try:
        evidence = store.load(folder)
    except (EOFError, ValueError, KeyError, OSError, zipfile.BadZipFile) as error:
        raise ConfigurationError(
            f"{folder}: report.npz cannot be read ({type(error).__name__}); run magjax {again} again"
        ) from None
    if name == "diagnosis":
        from .diagnosis_page import diagnosis_page as make
    else:
        from .fit_page import fit_page as make
    try:
        page = make(content, evidence, say)
    except (KeyError, TypeError) as error:
        raise ConfigurationError(f"{path}: is no result ({type(error).__name__}: {error}); run magjax {again} again") from None
    return render(folder / "report.html", page, content.get("reproduce", ""), content.get("versions", ""), f"{name}.json")


def _with_numbers(row):
    """A JSON object whose numbers that are always there are NaN where a fit broke down: the file has null for them."""
    always = (*ALWAYS, "stderr") if "free" in row else ALWAYS
    return {k: float("nan") if v is None and k in always else v for k, v in row.items()}


def _read(path):
    try:
        return json.loads(path.read_text(encoding="utf-8"), object_hook=_with_numbers)
    except (ValueError, OSError) as error:
        raise ConfigurationError(f"{path}: not valid JSON ({error}); run the fit or the diagnosis again") from None


def render(target: Path, page: dict, reproduce: str, versions: str = "", source: str = "") -> Path:
    """Write one page from its sections, and its figures as files beside it."""
    from jinja2 import Environment

    for there, wrong in ((target, target.is_dir()), (target.parent / "figures", (target.parent / "figures").is_file())):
        if wrong:
            raise ConfigurationError(f"{there}: stands where the report goes; move it away")
    pictures = [part["picture"] for s in page["sections"] for part in s["parts"] if part.get("picture")]
    if pictures:
        shapes = target.parent / "figures"
        shapes.mkdir(exist_ok=True)
        for picture in pictures:
            write_atomically(shapes / f"{picture.stem}.svg", '<?xml version="1.0" encoding="utf-8"?>\n' + picture.svg)
            write_atomically(shapes / f"{picture.stem}.png", picture.png)
    environment = Environment(autoescape=True, trim_blocks=True)
    environment.filters["kept_together"] = kept_together
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    words = {"advice": "", "command": "", "defined": "", **page, "reproduce": reproduce, "versions": versions}
    text = template.render(**words, source=source or target.with_suffix(".json").name, drawn=bool(pictures))
    write_atomically(target, text)
    return target


UNIT = re.compile(r"(?<=[\d∞]) (?=(?!(?:to|in|of|and|not|from|by|strong)\b)[%°µ√A-Za-z]|1/)| (?=± )|(?<=±) ")


def kept_together(text: str) -> str:
    """A text whose numbers do not part from their units and errors where the line ends."""
    return UNIT.sub("\u00a0", text)


def section(title: str, *parts) -> dict | None:
    """A section with its parts; parts that are None or empty are left out, and so is a section without parts."""
    kept = [p for p in parts if p]
    return {"id": "".join(c if c.isalnum() else "-" for c in title.lower()), "title": title, "parts": kept} if kept else None


def part(**content) -> dict | None:
    """One part: any of heading, text, bullets, code, table, picture; None where all but the heading are empty."""
    content = {k: v for k, v in content.items() if v}
    return content if set(content) - {"heading"} else None


class Sketch:
    """Draws pictures one by one, tells which, and skips those whose evidence is not there."""

    def __init__(self, say):
        self.say = say

    def __call__(self, present, draw, *arguments, **options) -> dict | None:
        """The part with the drawn picture, or None where `present` is empty."""
        if not present:
            return None
        self.say(draw.__name__.replace("_", " "))
        return part(picture=draw(*arguments, **options))
