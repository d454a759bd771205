"""The figures of T&B's own numbers: their loops (Figs. 7 and 8) and their table of damping ratios (Fig. 6)."""

import matplotlib
import numpy as np

from .style import INK, canvas, picture, plain, styled

WIDTH = 10.0


def paper_loops(families, stem: str = "paper_loops"):
    """Displacement against current: name of the range -> list of (frequency, current, displacement)."""
    colours = matplotlib.colormaps["cividis"]
    with styled():
        figure = canvas(WIDTH, 4.0)
        highest = 1.08 * max(float(y.max()) for loops in families.values() for _, _, y in loops) * 1e6
        for i, (name, loops) in enumerate(families.items()):
            axes = figure.add_axes([0.065 + 0.48 * i, 0.13, 0.43, 0.76])
            for k, (f, current, y) in enumerate(loops):
                colour = colours(0.9 * k / len(loops))
                axes.plot(np.append(current, current[0]), 1e6 * np.append(y, y[0]), color=colour, lw=1.1, label=f"{plain(f, 4)} Hz")
            axes.set(title=name, xlabel="current / A", ylim=(None, highest))
            if i == 0:
                axes.set_ylabel("displacement / µm")
        axes.legend(loc="upper left", ncols=2)  # the second range leaves room above its loops
        caption = "Displacement against current at seven frequencies for two ranges of current, with the paper's constants."
        return picture(figure, stem, "T&B's loops with their constants", caption)


def lag_table(table, stem: str = "lag_table"):
    """xi against frequency for each R_eddy, as T&B Fig. 6."""
    colours = matplotlib.colormaps["cividis"]
    with styled():
        figure = canvas(WIDTH, 3.6)
        axes = figure.add_axes([0.065, 0.14, 0.9, 0.82])
        for k, (R, row) in enumerate(zip(table.resistances, table.xi, strict=True)):
            picked = R == table.R_eddy
            colour = INK if picked else colours(0.9 * k / len(table.xi))
            axes.plot(table.frequencies, row, marker="o", ms=3, lw=2.2 if picked else 0.8, color=colour)
            if k % 2 == 0 or picked:
                axes.annotate(
                    f"{R:g} ohm",
                    (table.frequencies[0], row[0]),
                    fontsize=7,
                    textcoords="offset points",
                    xytext=(-6, -2),
                    ha="right",
                )
        axes.set(xlabel="frequency / Hz", ylabel="damping ratio ξ", ylim=(0, 1.6), xlim=(-25, None))
        caption = (
            "Damping ratio from the phase lag against frequency, one line for each R_eddy of the mesh; the picked one is thick."
        )
        return picture(figure, stem, "Damping ratio against frequency for each R_eddy", caption)
