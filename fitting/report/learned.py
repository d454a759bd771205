"""The learned function of an `unknown_at`: its picture with its band, what it is worth, and the boundaries that were compared."""

import numpy as np

from . import tables
from .page import part
from .style import BLUE, MUTED, PALE, canvas, per, percent, picture, plain, styled, unit_text

SHOWN = 8  # boundaries of the table, and any further one that was fitted
FITTED = ("fitted jointly: χ²/N", "left out: χ²/N")
UNITS = {"m": (1e6, "µm"), "m/s": (1e3, "mm/s"), "A/m": (1e-3, "kA/m"), "A": (1.0, "A"), "T": (1e3, "mT")}


def parts(unknown, sketch) -> list:
    """Parts of the page about the learned function, none where there is none."""
    if "function" not in unknown:
        return []
    before, after = unknown["left_out"]
    rows = [
        ["function of", _joined(unknown["variables"])],
        ["share of the excess that it takes", percent(unknown["share"])],
        ["χ²/N of recordings left out one at a time", f"{plain(before)} → {plain(after)}"],
        ["rms over the range seen", _with_unit(unknown["rms"], unknown["unit"])],
        ["bends over", f"{percent(unknown['bends_over'])} of the range"],
    ]
    if unknown.get("turns_within") is not None:
        rows.append(["after a turn the direction comes round within", _with_unit(unknown["turns_within"], unknown["variable_units"][0])])
    text = (
        "It was fitted jointly with the density and all constants, held by the prior of a smooth random function, and is in the model of this "
        "folder as learned_term. It models what is missing; it does not say what it is. Beyond the range seen it stays as at its edge, and its "
        "interval widens."
    )
    return [
        part(text=text, table=tables.table("The learned function", ["question", "answer"], rows)),
        sketch(unknown["function"], learned_function, unknown),
        _boundaries(unknown),
    ]


def _joined(variables):
    return " and ".join(variables).replace(" and times_", ", times ").replace("_", " ")


def in_units(unit: str) -> tuple[float, str]:
    """(factor, unit) in which a quantity of the learned function is shown, the same in its table and its picture."""
    return UNITS.get(unit, (1.0, unit_text(unit) or "1"))


def _with_unit(value, unit):
    factor, label = in_units(unit)
    return f"{plain(factor * value)} {label}"


def _place(boundary) -> tuple:
    """What makes a boundary: its block and its variables."""
    return boundary["block"], tuple(boundary["variables"])


def _choice(boundary, unknown) -> str:
    """What became of a boundary; "" where the folder does not say."""
    if _place(boundary) == _place(unknown):
        return "kept"
    if _place(boundary) in map(_place, unknown["rivals"]):
        return "not told from it"
    return "" if "left_out" not in boundary else "tried, worse" if _tried(boundary) else "not tried"


def _tried(boundary) -> bool:
    """Whether a function was fitted there; it may have been given up before it foretold anything."""
    chi2 = boundary.get("chi2_per_sample")
    return chi2 is not None and bool(np.isfinite(chi2))


def _boundaries(unknown):
    boundaries, kept = unknown["boundaries"], _place(unknown)
    told = any("left_out" in b for b in boundaries)  # a folder of before does not say which were tried
    columns = [tables.aligned([[b.get(key)] for b in boundaries]) for key in ("chi2_per_sample", "left_out")]
    rows = []
    for rank, (b, chi2, left_out) in enumerate(zip(boundaries, *columns, strict=True)):
        if rank < SHOWN or _tried(b) or _place(b) == kept:
            first_order = [b["block"], _joined(b["variables"]), plain(b["evidence"]), percent(b["share"]), percent(b["visibility"])]
            rows.append([*first_order, *((*chi2, *left_out) if told else ()), _choice(b, unknown)])
    note = (
        "Evidence, share and visibility are to first order, before the joint fits. Evidence: natural logarithm of how much more probable the misfit "
        "is with a smooth function there than without. Visible: the part of it that density and constants cannot make. The best by evidence "
        "(where none of them serves, or from far off none meets the noise nor, simple, comes near it, the simple ones of the other blocks, too, and "
        "from far off those of one variable) "
        "were fitted jointly with all else on the plain model's density; what "
        "decides among these is the χ²/N of recordings left out one at a time, and of those that come near each other there, the simpler, then the more visible one. "
        "The one that was kept may then have been given a finer density."
    )
    head = ["block", "function of", "evidence", "share explained", "visible", *(FITTED if told else ()), "choice"]
    return part(table=tables.table("Where a smooth function would serve", head, rows, note))


def learned_function(unknown, stem: str = "learned"):
    """The function with its 95 % band over its first variable, a panel for each value of the second; the range seen is white,
    beyond it grey."""
    x = np.asarray(unknown["function"]["x"])
    factor, label = in_units(unknown["variable_units"][0])
    scale, output = in_units(unknown["unit"])
    slices = unknown["function"]["slices"]
    seen = [factor * v for v in unknown["seen"][0]]
    inside = (x >= unknown["seen"][0][0]) & (x <= unknown["seen"][0][1])
    ends = [scale * f([f(np.asarray(s[k])[inside]) for s in slices]) for k, f in (("low", np.min), ("high", np.max))]
    room = 0.25 * (ends[1] - ends[0])
    with styled():
        figure = canvas(10.0, 2.8)
        for k, s in enumerate(slices):
            axes = figure.add_axes([0.075 + k * 0.92 / len(slices), 0.19, 0.92 / len(slices) - 0.045, 0.68])
            axes.fill_between(factor * x, scale * np.asarray(s["low"]), scale * np.asarray(s["high"]), color=BLUE, alpha=0.18, lw=0)
            axes.plot(factor * x, scale * np.asarray(s["value"]), color=BLUE)
            for beyond in ((factor * x[0], seen[0]), (seen[1], factor * x[-1])):
                axes.axvspan(*beyond, color=PALE, alpha=0.35, lw=0)
            axes.axhline(0, color=MUTED, lw=0.5)
            axes.set(xlim=(factor * x[0], factor * x[-1]), ylim=(ends[0] - room, ends[1] + room))
            axes.set(xlabel=f"{unknown['variables'][0].replace('_', ' ')} / {per(label)}", title=_slice(unknown, s))
            if k == 0:
                axes.set_ylabel(f"added at the {unknown['block']} / {per(output)}")
        less = f"what {unknown['mean_in']} takes up (its mean at each value of the factor)" if unknown.get("mean_in") else "its mean"
        caption = (
            f"Learned function: what the {unknown['block']} adds beside the model, with its 95 % interval, less {less}. Grey: beyond what the recordings "
            "reached, where it is held and its interval widens."
        )
        middle = slices[0]
        words = f"From {plain(scale * middle['value'][0])} to {plain(scale * middle['value'][-1])} {output}."
        return picture(figure, stem, "Learned function", caption, words)


def _slice(unknown, s) -> str:
    """Where in the second variable a panel lies, "" where there is no second."""
    if s["at"] is None:
        return ""
    name = unknown["variables"][1].removeprefix("times_").replace("_", " ")
    if name.endswith(" direction"):
        return name.replace("direction", "rising" if s["at"] > 0 else "falling")
    factor, label = in_units(unknown["variable_units"][1])
    return f"{name} {plain(factor * s['at'])} {label}"
