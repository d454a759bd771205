"""The Preisach plane: masses and their standard errors, cells that no recording switches hatched."""

import numpy as np
from matplotlib.colors import PowerNorm

from .style import INK, MUTED, SEQUENTIAL, canvas, per, percent, picture, styled, terms_in


def told(evidence, fit) -> str:
    """Of what the density of a fit is made, and how much of the plane its recordings say nothing of, in words."""
    made = fit.get("density")  # results of earlier versions do not say it
    return " ".join(filter(None, [f"The density is made of {made}." if made else "", never_switched(evidence)]))


def never_switched(evidence) -> str:
    """How much of the plane the recordings say nothing of, in words; "" where there is no evidence."""
    if "plane" not in evidence:
        return ""
    seen = evidence["plane"]["seen"].astype(bool)
    lower = np.tril(np.ones(seen.shape, bool))
    count, blind = int(lower.sum()), int((lower & ~seen).sum())
    if not blind:
        return f"Every one of the {count} cells is switched by some recording."
    return f"{blind} of {count} cells {'was' if blind == 1 else 'were'} never switched by any recording: their masses rest on smoothness alone."


def mass_map(evidence, stem: str = "masses", doubt: str = ""):
    """Masses (left) and their standard errors (right) over beta and alpha; `doubt`: what is wrong with the errors, if anything."""
    found = evidence["plane"]
    lower = np.tril(np.ones(found["masses"].shape, bool))
    seen = found["seen"].astype(bool) & lower
    terms = terms_in(evidence)
    scale, unit = terms.scaled(np.abs(found["levels"]).max())
    levels = scale * found["levels"]
    known = np.isfinite(found["errors"]).all()
    masses, errors = found["masses"], found["errors"]
    share = float(masses[seen].sum() / max(masses[lower].sum(), 1e-300))
    blind = int((lower & ~seen).sum())
    well = float(masses[seen & (errors < 0.3 * masses)].sum() / max(masses[seen].sum(), 1e-300)) if known else float("nan")
    with styled():
        figure = canvas(10.0, 4.3)
        _panel(figure, 0.07, masses, lower, seen, levels, unit, f"mass of a cell / {per(terms.state_unit)}", "Masses")
        if known:
            _panel(figure, 0.57, errors, lower, seen, levels, unit, f"standard error / {per(terms.state_unit)}", "Standard errors")
        caption = (
            f"Masses of the relays over their thresholds, at level {len(masses)}, and the standard error of each; colours go with the square root. "
            + (
                f"Hatched: the {blind} cells that no recording switches; their masses rest on the smoothness that is assumed alone. "
                f"{percent(share)} of the mass is switched."
                if blind
                else "Every cell is switched by some recording; one that none switches would be hatched."
            )
        )
        if known:
            caption += f" Of the switched mass {percent(well)} is in cells whose standard error is below 30 %{f' (errors {doubt})' if doubt else ''}."
            caption += " Errors swing with the knots of the density, and are none where a mass is held at zero."
        return picture(figure, stem, "Preisach masses and their standard errors", caption)


def _panel(figure, left, values, lower, seen, levels, unit, label, title):
    axes = figure.add_axes([left, 0.12, 0.335, 0.335 * 10 / 4.3])
    shown = np.ma.masked_where(~seen, values)
    extent = (levels[0], levels[-1], levels[0], levels[-1])
    # on the diagonal stands what has no hysteresis, as much as all the rest
    filled = values[seen & (values > 0) & ~np.eye(len(values), dtype=bool)]
    top = float(np.quantile(filled, 0.995)) if len(filled) else 1.0
    drawn = axes.imshow(shown, origin="lower", extent=extent, cmap=SEQUENTIAL, norm=PowerNorm(0.5, 0, top), interpolation="nearest")
    unseen = lower & ~seen
    if unseen.any():
        # each cell by two points just inside its edges, so that the outline runs along them
        inside = 1e-6 * (levels[1] - levels[0])
        ends = np.stack([levels[:-1] + inside, levels[1:] - inside], axis=1).ravel()
        cells = unseen.astype(float).repeat(2, axis=0).repeat(2, axis=1)
        axes.contourf(ends, ends, cells, levels=[0.5, 1.5], colors=["#ededed"], hatches=["////"])
    axes.plot([levels[0], levels[-1]], [levels[0], levels[-1]], color=MUTED, lw=0.6)
    axes.set(xlabel=f"β / {per(unit)}", ylabel=f"α / {per(unit)}", xlim=extent[:2], ylim=extent[2:])
    axes.set_title(title, loc="left", color=INK)
    bar = figure.colorbar(drawn, cax=figure.add_axes([left + 0.345, 0.12, 0.012, 0.335 * 10 / 4.3]), extend="max")
    bar.set_label(label)
