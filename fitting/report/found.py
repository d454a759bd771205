"""Figures of a diagnosis: the chain of blocks with what each could explain, where the misfit sits, the ranking, the shifts."""

import numpy as np

from .residuals import repeating
from .style import BLUE, INK, MUTED, PALE, SKY, VERMILION, canvas, percent, picture, plain, scale_of, styled, words

WIDTH = 10.0
BLOCKS = ("source", "coil", "hysteresis", "magnetostriction", "mechanics", "sensor")
THRESHOLD = 5.5  # of |z|, as the search uses it


def block_map(where, marks, drive: str, met: bool = False, stem: str = "blocks"):
    """The chain of blocks, each shaded by the share of what is above the noise that its best effect could explain; `marks`:
    block -> what the verdict says of it; `met`: nothing is above the noise, and there are no shares of it."""
    shares = where["by_block"]
    shown = [b for b in BLOCKS if b in shares or b in marks]
    told = {b: "–" if met else percent(shares.get(b, 0.0)) for b in shown}
    wide = 1.0 / max(len(shown), 1)
    with styled():
        figure = canvas(WIDTH, 1.45)
        axes = figure.add_axes([0.005, 0.02, 0.99, 0.96])
        axes.set(xlim=(0, 1), ylim=(0, 1))
        axes.axis("off")
        for k, block in enumerate(shown):
            share = 0.0 if met else float(shares.get(block, 0.0))
            left = k * wide + 0.012
            tint = np.array([1.0, 1.0, 1.0]) * (1 - share) + np.array([0.90, 0.62, 0.0]) * share
            named = block in marks
            axes.add_patch(_box(left, wide - 0.03, tint, 2.4 if named else 0.8))
            axes.text(left + 0.5 * (wide - 0.03), 0.70, block, ha="center", va="center", fontweight="bold" if named else "normal")
            axes.text(left + 0.5 * (wide - 0.03), 0.47, told[block], ha="center", va="center", fontsize=11)
            axes.text(left + 0.5 * (wide - 0.03), 0.25, marks.get(block, ""), ha="center", va="center", fontsize=7.5)
            if k + 1 < len(shown):
                axes.annotate(
                    "",
                    xy=(left + wide - 0.006, 0.5),
                    xytext=(left + wide - 0.03, 0.5),
                    arrowprops={"arrowstyle": "->", "color": MUTED, "lw": 1},
                )
        caption = (
            f"The chain from {drive} to reading. The percentage is the share of what is above the noise that the best single effect of the block could "
            "take, to first order; blocks overlap, so shares do not add up. A thick frame marks the blocks of which the verdict speaks."
            if not met
            else f"The chain from {drive} to reading. The model meets the noise: nothing is above it that a block could have a share of."
        )
        words = ", ".join(f"{b} {told[b]}" + (f" ({marks[b]})" if b in marks else "") for b in shown)
        return picture(figure, stem, "Block map: what each block could explain", caption, words)


def _box(left, width, tint, line):
    from matplotlib.patches import FancyBboxPatch

    return FancyBboxPatch(
        (left, 0.1), width, 0.8, boxstyle="round,pad=0,rounding_size=0.012", mutation_aspect=7, fc=tint, ec=INK, lw=line
    )


def places(where, evidence, output: str, stem: str = "places"):
    """Misfit by branch, by quarter of the field and by period, against what noise alone would leave."""
    fine, unit = scale_of(output)[2:]
    noise = fine * float(np.sqrt(np.mean(repeating(evidence)[1] ** 2)))
    with styled():
        figure = canvas(WIDTH, 2.7)
        groups = (
            ("by branch", list(where["by_branch"]), list(where["by_branch"].values())),
            ("by part of the drive's range", ["lowest\nquarter", "second", "third", "highest\nquarter"], where["by_field"]),
        )
        highest = 1.4 * max(noise, *(fine * max(v) for _, _, v in groups))
        for k, (title, names, values) in enumerate(groups):
            axes = figure.add_axes([0.07 + 0.33 * k, 0.2, 0.24, 0.7])
            axes.bar(range(len(values)), fine * np.asarray(values), color=SKY, ec=INK, lw=0.5, width=0.65)
            axes.axhline(noise, color=INK, lw=1, ls=(0, (4, 2)), label="noise of what repeats")
            axes.legend(loc="upper right", borderaxespad=0)
            axes.set_xticks(range(len(values)), names)
            axes.set(title=title, ylim=(0, highest))
            if k == 0:
                axes.set_ylabel(f"misfit, rms / {unit}")
        axes = figure.add_axes([0.74, 0.2, 0.24, 0.7])
        rows = where["by_period"]
        for row in rows:
            axes.plot(np.arange(1, len(row) + 1), fine * np.asarray(row), marker="o", ms=2.5, lw=0.8, color=BLUE, alpha=0.7)
        axes.axhline(fine * float(np.median(evidence["noise"])), color=INK, lw=1, ls=(0, (4, 2)), label="noise of a sample")
        axes.legend(loc="lower right", borderaxespad=0.4)
        top = max((max(r) for r in rows), default=1.0)
        axes.set(title="by period (does not repeat)", xlabel="period", ylim=(0, 1.2 * fine * top))
        axes.xaxis.get_major_locator().set_params(integer=True)
        caption = (
            "Rms misfit of the plain model on rising and falling branches and near the turning points, in quarters of the drive's range, and, "
            "right, what does not repeat from period to period, one line a recording. Dashed: what noise alone leaves of each; of what repeats it leaves less."
        )
        words = ", ".join(f"{n} {plain(fine * v)} {unit}" for n, v in where["by_branch"].items())
        return picture(figure, stem, "Where in the loop the misfit sits", caption, words)


def ranking(candidates, stem: str = "ranking", count: int = 16):
    """|z| of the leading candidates; dark where fitted for real."""
    rows = candidates[:count][::-1]
    scores = np.nan_to_num(np.array([abs(c["z"]) for c in rows]))
    height = 0.75 + 0.23 * len(rows)
    with styled():
        figure = canvas(WIDTH, height)
        axes = figure.add_axes([0.235, 0.45 / height, 0.62, 1 - 0.55 / height])
        fitted = [c["achieved_chi2_drop"] is not None for c in rows]
        axes.barh(range(len(rows)), scores, color=[BLUE if f else PALE for f in fitted], ec=INK, lw=0.4, height=0.7)
        axes.axvline(THRESHOLD, color=VERMILION, lw=1.2, ls=(0, (4, 2)))
        reach = max(1.05 * float(scores.max()), 1.5 * THRESHOLD)
        axes.set_xscale("function", functions=(lambda x: np.sqrt(np.maximum(x, 0)), np.square))
        ticks = [t for t in (0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000) if t <= reach]
        ticks = [t for t in ticks if t == 0 or t > 0.004 * reach]
        axes.set_xlim(0, reach)
        axes.set_xticks(ticks, [str(t) for t in ticks])
        for k, c in enumerate(rows):
            if c["achieved_chi2_drop"] is not None:
                axes.text(
                    1.01,
                    k,
                    f"χ² {'fell' if c['achieved_chi2_drop'] >= 0 else 'rose'} by {plain(abs(c['achieved_chi2_drop']))}",
                    transform=axes.get_yaxis_transform(),
                    va="center",
                    fontsize=7.5,
                )
        axes.set_yticks(range(len(rows)), [words(c["name"]) for c in rows])
        axes.set_ylim(-0.6, len(rows) - 0.4)
        axes.set_xlabel("score |z|, standard deviations")
        caption = (
            "Score of each effect on what the plain model leaves, off everything that the plain model can do itself (root scale). Dashed: the "
            f"threshold of {THRESHOLD}. Dark: fitted for real, with the fall of χ² that it achieved."
        )
        lead = "; ".join(f"{words(c['name'])} {plain(abs(c['z']))}" for c in candidates[:5])
        return picture(figure, stem, "Ranking of the catalogue", caption, f"Leaders: {lead}.")
