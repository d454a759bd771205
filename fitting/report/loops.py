"""Figures over one period: loops with their residual strips, a zoom in time, the signals inside, check recordings."""

import numpy as np

from magjax.terms import terms_of

from .style import (
    BLUE,
    INK,
    MEASURED,
    MODEL,
    MUTED,
    ORANGE,
    PALE,
    SKY,
    VERMILION,
    canvas,
    drive_label,
    per,
    picture,
    plain,
    scale_of,
    styled,
    unit_text,
)

COLUMNS = 3
WIDTH = 10.0  # inches
SHOWN = 12  # check recordings
LEGEND = 0.25  # inches, a line of it
HANDLE = 2.5  # of its lines, in its font's size
HINTED = 1.08  # times its width that a text takes where it is drawn in pixels


def loops(evidence, output: str, drive: str, after=None, added: str = "", stem: str = "loops"):
    """Measured and simulated loops with a residual strip each; `after`: the same of a repaired model, `added`: what it adds."""
    names, frequency = evidence["name"], evidence["frequency"]
    panels = []
    for k in evidence["chosen"]:
        loop = dict(evidence["loops"][str(k)])
        title = f"{names[k]}\n{plain(frequency[k])} Hz, χ²/N {plain(evidence['chi2'][k])}"
        strips = [("model", loop["model"] - loop["measured"])]
        if after is not None and str(k) in after["loops"]:
            second = after["loops"][str(k)]
            loop["after"] = second["model"] + loop["measured"] - second["measured"]
            strips.append(("after", second["model"] - second["measured"]))
            title = f"{names[k]}\n{plain(frequency[k])} Hz, χ²/N {plain(evidence['chi2'][k])} → {plain(after['chi2'][k])}"
        panels.append((title, loop, strips))
    what = "fitted" if after is None else "simulated before and after the repair"
    title = f"Measured and {what} loops"
    total = len(names)
    some = (
        ""
        if len(panels) == total
        else f" {len(panels)} of {total} recordings are shown: the worst, and others over the frequencies."
    )
    worst = int(np.argmax(evidence["chi2"]))
    detail = f"The worst recording is {names[worst]} with χ²/N {plain(evidence['chi2'][worst])}."
    caption = (
        "Above: the reading (mean of the periods) and the model against the drive. Below: model less measurement over one period, with "
        f"twice the noise of the mean as the band.{some}"
    )
    return _panels(panels, output, drive, stem, title, caption, detail, added)


def checks(entries, output: str, drive: str, rows, repaired: bool = True, added: str = "", stem: str = "checks"):
    """Check recordings: measured, predicted before and after, or by the one model that there is; `added`: as in `loops`."""
    panels = []
    for key, entry in list(entries.items())[:SHOWN]:
        row = rows[int(key)]
        loop = {**entry, "model": entry["before"]}
        strips = [("model", entry["before"] - entry.get("recorded", entry["measured"]))]
        if repaired:
            strips.append(("after", entry["after"] - entry["measured"]))
        else:
            loop.pop("after")
            loop["called"] = "predicted"
        factor, unit = scale_of(output)[2:]
        size = " → ".join(plain(factor * row[k]) for k in (("rms_before", "rms_after") if repaired else ("rms_after",)))
        panels.append((f"{entry['name']}\nrms {size} {unit}, noise {plain(factor * row['noise_rms'])}", loop, strips))
    when = " before and after the repair" if repaired else ""
    caption = (
        f"Recordings that took no part in any fit: the reading and its prediction{when}, and below them prediction less measurement with twice "
        "the noise of the mean as the band."
    )
    return _panels(panels, output, drive, stem, f"Check recordings{when}", caption, "", added)


def _panels(panels, output, drive, stem, title, caption, detail, added="", lines_of_legend=1):
    factor, label, fine, unit = scale_of(output)
    drive_factor, drive_name = drive_label(drive)
    columns = min(COLUMNS, max(len(panels), 1))
    rows = int(np.ceil(len(panels) / columns))
    height = 4.05  # of a loop with its strip
    with styled():
        legend = LEGEND * lines_of_legend
        total, width = rows * height + legend, WIDTH * max(columns, 2) / COLUMNS if columns < COLUMNS else WIDTH
        figure = canvas(width, total)
        for k, (heading, loop, strips) in enumerate(panels):
            row, column = divmod(k, columns)
            left, wide = (column + 0.19) / max(columns, 2), 0.76 / max(columns, 2)
            top = total - legend - row * height
            upper = figure.add_axes([left, (top - 2.40) / total, wide, 2.0 / total])
            lower = figure.add_axes([left, (top - 3.62) / total, wide, 0.7 / total])
            _loop(upper, loop, drive_factor, factor, heading)
            _strip(lower, loop, strips, fine)
            upper.set_xlabel(drive_name)
            lower.set_xlabel("part of the period")
            if column == 0:
                upper.set_ylabel(label)
                lower.set_ylabel(f"residual / {unit}")
            if k == 0:
                pairs = [p for axes in (upper, lower) for p in zip(*axes.get_legend_handles_labels(), strict=True)]
                lines, names = zip(*pairs, strict=True)
                names = [f"after, with {added}" if added and n == "after" else n for n in names]
                across = int(np.ceil(len(names) / lines_of_legend))
                if across > 1 and _legend_width(names, across) > width * (1 - left):
                    return _panels(panels, output, drive, stem, title, caption, detail, added, lines_of_legend + 1)
                figure.legend(lines, names, loc="upper left", bbox_to_anchor=(left, 1), ncols=across, borderaxespad=0, handlelength=HANDLE)
        return picture(figure, stem, title, caption, detail)


def _legend_width(names, columns: int) -> float:
    """Of a legend of so many columns, inches."""
    from matplotlib import rcParams
    from matplotlib.textpath import TextPath

    size = rcParams["legend.fontsize"]
    beside = (HANDLE + rcParams["legend.handletextpad"] + rcParams["legend.columnspacing"]) * size
    widths = [HINTED * TextPath((0, 0), name, size=size).get_extents().width + beside for name in names]
    return sum(max(column) for column in np.array_split(widths, columns)) / 72


def _loop(axes, loop, drive_factor, factor, heading):
    drive = drive_factor * loop["drive"]
    close = lambda x: np.append(x, x[0])
    axes.plot(
        close(drive), factor * close(loop["measured"]), color=SKY, lw=3.2, alpha=0.75, solid_capstyle="round", label="measured"
    )
    axes.plot(
        close(drive),
        factor * close(loop["model"]),
        color=MODEL,
        lw=1.0,
        ls=(0, (4, 1.6)),
        label="before" if "after" in loop else loop.get("called", "fitted"),
    )
    if "after" in loop:
        axes.plot(close(drive), factor * close(loop["after"]), color=INK, lw=0.8, label="after")
    axes.set_title(heading, loc="left", linespacing=1.3)
    axes.margins(0.04)
    axes.locator_params(axis="x", nbins=5)
    axes.locator_params(axis="y", nbins=6)


def _strip(axes, loop, strips, fine):
    phase = loop["phase"]
    band = 2 * fine * float(np.median(loop["noise"]))  # bins that do not divide the period hold one sample more or less
    axes.axhspan(-band, band, color=PALE, lw=0, label="twice the noise of the mean")
    axes.axhline(0, color=MUTED, lw=0.5)
    below = {"lw": 2.6, "alpha": 0.45} if len(strips) > 1 else {"lw": 0.9}  # seen under the other
    styles = {"model": {"color": MODEL, **below}, "after": {"color": INK, "lw": 0.8}}
    for key, values in strips:
        axes.plot(phase, fine * values, **styles[key])
    reach = max(np.max(np.abs(fine * values)) for _, values in strips)
    reach = max(1.1 * reach, 1.6 * band)
    axes.set(xlim=(0, 1), ylim=(-reach, reach))
    axes.locator_params(axis="y", nbins=3)


def zoom(evidence, output: str, stem: str = "zoom"):
    """Raw samples and the model about the largest misfit of two recordings, the difference below."""
    factor, label, fine, unit = scale_of(output)
    keys = list(evidence["zoom"])
    with styled():
        figure = canvas(WIDTH, 3.9)
        for i, key in enumerate(keys):
            wide = 0.41 if len(keys) > 1 else 0.9
            axes, below = (figure.add_axes([0.07 + i / 2, y, wide, h]) for y, h in ((0.42, 0.49), (0.12, 0.2)))
            part, k = evidence["zoom"][key], int(key)
            time = 1e3 * part["time"]
            axes.plot(time, factor * part["measured"], ls="", marker=".", ms=3.4, mew=0, color=MEASURED, label="samples")
            axes.plot(time, factor * part["model"], color=MODEL, lw=1.2, label="fitted")
            axes.set_title(f"{evidence['name'][k]}, {plain(evidence['frequency'][k])} Hz", loc="left")
            band = 2 * fine * float(evidence["noise"][k])
            below.axhspan(-band, band, color=PALE, lw=0)
            below.axhline(0, color=MUTED, lw=0.5)
            below.plot(time, fine * (part["model"] - part["measured"]), ls="", marker=".", ms=3, mew=0, color=MEASURED)
            below.plot(time, fine * part["misfit"], color=MODEL, lw=1.2)
            below.set_xlabel("time / ms")
            if i == 0:
                axes.set_ylabel(label)
                below.set_ylabel(f"residual / {unit}")
                axes.legend()
            for ax in (axes, below):
                ax.margins(0.03, 0.08)
            axes.locator_params(axis="y", nbins=5)
            below.locator_params(axis="y", nbins=3)
        which = "the worst recording and the fastest" if len(keys) > 1 else "the worst recording"
        caption = (
            f"Samples as recorded and the model about the moment of the largest misfit, {which}. Below: model less samples, the part that "
            "repeats every period as a line, and twice the noise of a sample as the band."
        )
        return picture(figure, stem, "Time zoom at the largest misfit", caption)


def inside(evidence, drive: str, stem: str = "inside"):
    """H, I_1 and M over a period, and M against H, of a few recordings."""
    keys = sorted(evidence["inside"], key=lambda k: evidence["frequency"][int(k)])
    with_current = "I_1" in evidence["inside"][keys[0]]
    terms = terms_of(drive)
    rows = ["H", "I_1", "M", "loop"] if with_current else ["M", "loop"] if drive == "voltage" else ["H", "M", "loop"]
    heights = {"H": 1.25, "I_1": 1.25, "M": 1.25, "loop": 2.2}
    gap, top, bottom = 0.42, 0.32, 0.3
    total = sum(heights[r] for r in rows) + gap * (len(rows) - 1) + top + bottom + 0.25
    with styled():
        figure = canvas(WIDTH, total)
        for c, key in enumerate(keys):
            signals, y = evidence["inside"][key], total - top
            for row in rows:
                y -= heights[row]
                axes = figure.add_axes([(c + 0.2) / 3, y / total, 0.76 / 3, heights[row] / total])
                _inside_row(axes, row, signals, terms, c == 0)
                if row == "H":
                    axes.set_title(f"{evidence['name'][int(key)]}, {plain(evidence['frequency'][int(key)])} Hz", loc="left")
                y -= gap if row != "M" else 0.55
        words = (
            "the current I that is applied and I₁ = (H − H_bias)/c₀, which is left of it for the field; " if with_current else ""
        )
        which = "the field that is applied and the field H in the rod; " + words if "H" in rows else ""
        caption = (
            f"Signals that no instrument reads, as the fitted model has them: {which}"
            f"the {terms.state} {terms.state_letter}; and {terms.state_letter} against {terms.field_letter}."
        )
        shown = "H, I₁ and M" if with_current else "H and M" if "H" in rows else terms.state_letter
        return picture(figure, stem, f"Signals inside the model: {shown}", caption)


def _inside_row(axes, row, signals, terms, first):
    phase = signals["phase"]
    scale, unit = terms.scaled(np.abs(signals["H"]).max())
    magnet, magnet_unit = terms.scaled(np.abs(signals["M"]).max(), state=True)
    if row == "H":
        axes.plot(phase, scale * signals["applied"], color=SKY, lw=2.6, alpha=0.8, label="applied")
        axes.plot(phase, scale * signals["H"], color=INK, lw=0.9, label="H")
        label = f"field / ({unit})"
    elif row == "I_1":
        axes.plot(phase, signals["current"], color=SKY, lw=2.6, alpha=0.8, label="I")
        axes.plot(phase, signals["I_1"], color=INK, lw=0.9, label="I₁")
        label = "current / A"
    elif row == "M":
        axes.plot(phase, magnet * signals["M"], color=BLUE, lw=1.2)
        label = f"{terms.state_letter} / {per(magnet_unit)}"
    else:
        close = lambda x: np.append(x, x[0])
        axes.plot(scale * close(signals["H"]), magnet * close(signals["M"]), color=BLUE, lw=1.2)
        label = f"{terms.state_letter} / {per(magnet_unit)}"
        axes.set_xlabel(f"{terms.field_letter} / {per(unit)}")
    if row in ("H", "I_1") and first:
        axes.legend(loc="best", handlelength=1.2, borderaxespad=0)
    if first:
        axes.set_ylabel(label)
    if row == "M":
        axes.set_xlabel("part of the period")
    if row != "loop":
        axes.set_xlim(0, 1)
    axes.locator_params(axis="y", nbins=4)


def offender(entry, stem: str = "offender"):
    """The signal of a file that cannot be used: the whole of it, and about the place where it is at fault."""
    channel, timed = str(entry["channel"]), bool(entry["timed"])
    known = channel in ("displacement", "flux_density", "magnetization", "polarization")
    factor, label = (
        scale_of(channel)[:2] if known else (1.0, f"{channel.replace('_', ' ')} / {per(unit_text(str(entry['unit'])) or '1')}")
    )
    first, last = (1e3 if timed else 1.0) * np.asarray(entry["span"])
    with styled():
        figure = canvas(WIDTH, 2.6)
        for k, (key, title) in enumerate((("whole", f"{entry['name']}, as recorded"), ("near", "about the place"))):
            axes = figure.add_axes([0.07 + 0.49 * k, 0.2, 0.42, 0.68])
            axes.axvspan(first, last, color=ORANGE, alpha=0.35, lw=0, label="here")
            at = (1e3 if timed else 1.0) * entry[key]["time"]
            axes.plot(at, factor * entry[key]["values"], color=BLUE, lw=1.0, marker="." if k else "", ms=2.5, mew=0)
            axes.set(title=title, xlabel="time / ms" if timed else "sample", xlim=(at[0], at[-1]))
            if k == 0:
                axes.set_ylabel(label)
                axes.legend(loc="best")
        caption = (
            "The signal for which the file cannot be used, as it was recorded, and the samples about the place, which is marked."
        )
        return picture(
            figure, stem, "The signal at fault", caption, f"From {plain(first)} to {plain(last)} {'ms' if timed else 'samples'}."
        )


def periods(entries, stem: str = "periods"):
    """The readings as recorded: the first and the last periods over each other."""
    columns = max(2, min(COLUMNS, len(entries)))
    rows = int(np.ceil(len(entries) / columns))
    colours = [VERMILION, BLUE, INK]
    with styled():
        figure = canvas(WIDTH * columns / COLUMNS, 2.6 * rows)
        for k, entry in enumerate(entries.values()):
            row, column = divmod(k, columns)
            factor, label = scale_of(str(entry["output"]))[:2]
            axes = figure.add_axes([(column + 0.19) / columns, 1 - (row + 0.80) / rows, 0.76 / columns, 0.62 / rows])
            for i, (number, reading) in enumerate(zip(entry["number"], entry["reading"], strict=True)):
                phase = np.arange(len(reading)) / len(reading)
                axes.plot(
                    phase,
                    factor * reading,
                    color=colours[i],
                    lw=[2.4, 1.4, 0.8][i],
                    ls=["-", (0, (4, 2)), "-"][i],
                    label=f"period {number}",
                )
            axes.set_title(
                f"{entry['name']}" + (f", {plain(float(entry['frequency']))} Hz" if entry["frequency"] else ""), loc="left"
            )
            axes.set_xlim(0, 1)
            axes.set_xlabel("part of the period")
            if column == 0:
                axes.set_ylabel(label)
            if k == 0:
                axes.legend(loc="best")
        caption = (
            "The readings as recorded, the first and the last two periods over each other; settled and sound recordings repeat."
        )
        return picture(figure, stem, "The recordings as they are", caption)
