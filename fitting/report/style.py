"""How figures look and how they become inline SVG: text stays text, numbers are short, nothing points outside.

Colours are those of Okabe and Ito, which colour-blind readers tell apart; lines differ by dash or marker too.
"""

import dataclasses
import io
import re

from matplotlib import rc_context
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from magjax.terms import Terms, terms_of

INK, MUTED, PALE = "#1a1a1a", "#555555", "#c8c8c8"
BLUE, VERMILION, GREEN, ORANGE, SKY = "#0072B2", "#D55E00", "#007F5C", "#E69F00", "#56B4E9"
MEASURED, MODEL = BLUE, VERMILION
SEQUENTIAL = "cividis"
FONT = "system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', Arial, sans-serif"
RC = {
    "font.family": "DejaVu Sans", "font.size": 8.5, "axes.titlesize": 8.5, "axes.titley": 1.0, "axes.labelsize": 8.5, "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5, "legend.fontsize": 7.5, "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": MUTED,
    "axes.labelcolor": INK, "text.color": INK, "xtick.color": MUTED, "ytick.color": MUTED, "xtick.labelcolor": INK, "ytick.labelcolor": INK,
    "axes.linewidth": 0.6, "xtick.major.width": 0.6, "ytick.major.width": 0.6, "lines.linewidth": 1.2, "legend.frameon": False,
    "axes.axisbelow": True, "svg.fonttype": "none", "svg.hashsalt": "magjax", "hatch.linewidth": 0.5, "figure.dpi": 72, "path.simplify": True,
    "axes.formatter.useoffset": False, "axes.formatter.limits": (-3, 4), "axes.formatter.use_mathtext": False, "text.parse_math": False, "mathtext.fontset": "dejavusans",
}  # fmt: skip


def styled():
    """The context in which every figure is drawn."""
    return rc_context(RC)


def canvas(width: float, height: float) -> Figure:
    """An empty figure, inches."""
    figure = Figure(figsize=(width, height))
    FigureCanvasSVG(figure)
    return figure


def scale_of(output: str) -> tuple[float, str, float, str]:
    """(factor, label) of a reading and (factor, unit) of its residual."""
    return {
        "displacement": (1e6, "displacement / µm", 1e9, "nm"),
        "flux_density": (1.0, "flux density / T", 1e3, "mT"),
        "magnetization": (1e-3, "magnetization / (kA/m)", 1.0, "A/m"),
        "polarization": (1.0, "polarization / (C/m²)", 1e3, "mC/m²"),
    }[output]


def terms_in(evidence) -> Terms:
    """The words and units of the bench that the evidence is of; a magnetic one where it is not said."""
    return terms_of(str(evidence.get("drive", "current")))


def drive_label(drive: str) -> tuple[float, str]:
    """(factor, label) of the drive."""
    return 1.0, {"current": "current / A", "field": "applied field / (A/m)", "voltage": "voltage / V"}[drive]


def per(unit: str) -> str:
    """A unit after a slash: in brackets where it is a quotient."""
    return f"({unit})" if "/" in unit else unit


def plain(value: float, digits: int = 3) -> str:
    """A number as people write it: no exponent between 1e-3 and 1e5."""
    if value is None or value != value:
        return "–"
    if value == 0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        text = f"{value:.{digits}g}"
        return (f"{float(text):.0f}" if "e" in text else text).replace("-", "−")
    if abs(value) == float("inf"):
        return "∞"
    mantissa, exponent = f"{value:.{max(digits - 1, 0)}e}".split("e")
    mantissa = mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa
    return f"{mantissa}e{int(exponent)}".replace("-", "−")


@dataclasses.dataclass(frozen=True)
class Picture:
    """One figure of a page: `title` is its name for a screen reader, `caption` stands below it, `svg` is inline."""

    stem: str
    title: str
    caption: str
    svg: str
    png: bytes = b""


def picture(figure: Figure, stem: str, title: str, caption: str, description: str = "") -> Picture:
    """A drawn figure with its words; `description`: what the caption does not say, for those who do not see it."""
    return Picture(stem, title, caption, to_svg(figure, stem, title, f"{caption} {description}".strip()), to_png(figure))


def percent(share: float) -> str:
    """A share in whole per cent, "< 1 %" and "> 99 %" at the ends."""
    if share != share:
        return "–"
    return "0 %" if share <= 0 else "< 1 %" if share < 0.01 else "> 99 %" if 0.99 < share < 1 else f"{100 * share:.0f} %"


SPOKEN = {
    "delta_e": "ΔE effect",
    "duffing_stiffness": "Duffing stiffness",
    "coulomb_friction": "Coulomb friction",
    "learned_term": "the learned function",
}


def words(name: str) -> str:
    """An effect's name as people say it."""
    return SPOKEN.get(name, name.replace("_", " "))


def unit_text(unit: str) -> str:
    """A unit with raised exponents and roots; nothing for a number."""
    return (
        ""
        if unit == "1"
        else re.sub(r"(\([^()]*\)|\w+)\^0\.5", r"√\1", unit).replace("^2", "²").replace("^3", "³").replace("^-1", "⁻¹")
    )


def to_png(figure: Figure) -> bytes:
    """The figure as a PNG on white, for slides and programs that draw no SVG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=144, metadata={"Software": None}, pil_kwargs={"compress_level": 2})
    return buffer.getvalue()


def to_svg(figure: Figure, stem: str, title: str, description: str) -> str:
    """The figure as inline SVG with role, name and description; ids begin with `stem`."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].rstrip()
    svg = re.sub(r"<metadata>.*?</metadata>\s*", "", svg, flags=re.S)
    svg = re.sub(r"<!--.*?-->\s*", "", svg, flags=re.S)
    svg = re.sub(r' d="([^"]*)"', lambda m: f' d="{short_path(m[1])}"', svg)
    svg = re.sub(r' (?:x|y)="[^"]*"', lambda m: re.sub(r"(\d\.\d\d)\d+", r"\1", m[0]), svg)
    svg = re.sub(r'\bid="', f'id="{stem}-', svg)
    svg = re.sub(r'(xlink:href="#|url\(#)', rf"\g<1>{stem}-", svg)
    svg = _without_ballast(re.sub(r"\n\s*", "\n", svg))
    head, body = svg.split(">", 1)
    head += f' role="img" aria-label="{_escape(title)}" aria-describedby="{stem}-desc"'
    return f'{head}>\n<title>{_escape(title)}</title>\n<desc id="{stem}-desc">{_escape(description)}</desc>{body}'


def _without_ballast(svg: str) -> str:
    """What matplotlib repeats for every text and every mark, said once or not at all."""
    svg = re.sub(r" ?font-family: [^;\"]*;?", "", svg).replace("<svg ", f'<svg font-family="{FONT}" ', 1)
    svg = re.sub(r' transform="rotate\(-0 [^"]*\)"', "", svg)
    svg = re.sub(r"(rotate\([^)]*\))", lambda m: re.sub(r"(\d\.\d\d)\d+", r"\1", m[0]), svg)
    used = set(re.findall(r"#([\w.-]+)[\")]", svg))
    svg = re.sub(r' id="([^"]*)"', lambda m: m[0] if m[1] in used else "", svg)
    for _ in range(3):
        svg = re.sub(r"<g>\n(<(?:use|path) [^>]*/>|<text [^>]*>[^<]*</text>)\n</g>", r"\1", svg)
    return svg


def short_path(path: str) -> str:
    """The same path in fewer bytes: polylines in relative steps of 0.05 point without drift, curves to 0.01 point."""
    if set(re.findall("[A-Za-z]", path)) - set("MLz"):
        return re.sub(r"(\d\.\d\d)\d+", r"\1", " ".join(path.split()))
    made, at = [], (0, 0)
    for command, x, y in re.findall(r"([ML]) ([-\d.]+) ([-\d.]+)|z", path):
        if not command:
            made.append("z")
            continue
        point = round(20 * float(x)), round(20 * float(y))
        step = point if command == "M" else (point[0] - at[0], point[1] - at[1])
        if command == "M" or step != (0, 0):
            made.append(command.lower() if command == "L" else "M")
            made.append(" ".join(f"{v / 20:.4g}" if abs(v) < 2000 else f"{v / 20:.2f}" for v in step))
        at = point
    return "".join(made)


def _escape(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace('"', "&quot;")


def shown(value) -> str:
    """Any value of a result in words: numbers, and what holds them."""
    if isinstance(value, dict):
        return "; ".join(f"{words(str(k))}: {shown(v)}" for k, v in value.items()) or "none"
    if isinstance(value, (list, tuple)):
        return ", ".join(shown(v) for v in value) or "none"
    return plain(value, 4) if isinstance(value, float) else str(value)
