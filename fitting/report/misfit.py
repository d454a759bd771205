"""Figures of what a fit leaves: map over frequency and harmonic, along the record, against field, rate and frequency,
autocorrelation, spectrum, and how the objective fell."""

import numpy as np

from .style import (
    BLUE,
    GREEN,
    INK,
    MEASURED,
    MODEL,
    MUTED,
    ORANGE,
    PALE,
    SEQUENTIAL,
    SKY,
    VERMILION,
    canvas,
    per,
    picture,
    plain,
    scale_of,
    styled,
    terms_in,
)

WIDTH = 10.0
MARKERS = "os^Dv<>P"


def row_labels(evidence, order) -> list[str]:
    """What to call the recordings in `order`: by frequency, and by file too where others have the same."""
    texts = [f"{plain(evidence['frequency'][k], 4)} Hz" for k in order]
    named = [f"{str(evidence['name'][k])[-20:]}, {text}" for k, text in zip(order, texts, strict=True)]
    return [name if texts.count(text) > 1 else text for name, text in zip(named, texts, strict=True)]


def _over_noise(evidence) -> np.ndarray:
    """Misfit of every line over its noise, nan where it has none."""
    return evidence["lines"]["misfit"] / evidence["lines"]["floor"]


def misfit_map(evidence, stem: str = "misfit", title: str = "Misfit over noise by frequency and harmonic", beside=None):
    """Amplitude of the misfit over the noise of its line, recordings by frequency down, harmonics across; `beside`: evidence of
    another model, whose map has the same colours."""
    ratio = _over_noise(evidence)
    order = np.argsort(evidence["frequency"], kind="stable")
    shown = np.log10(np.maximum(np.where(np.isfinite(ratio), ratio, 0.0), 0.3))[order]
    R, H = shown.shape
    height = 1.0 + min(0.26 * R + 0.3, 6.0)
    worst = np.unravel_index(int(np.nanargmax(np.where(np.isfinite(ratio), ratio, 0))), ratio.shape)
    with styled():
        figure = canvas(WIDTH, height)
        axes = figure.add_axes([0.16, 0.62 / height, 0.70, 1 - 0.67 / height])
        top = max(1.0, float(shown.max()), *(float(np.log10(np.nanmax(_over_noise(e)))) for e in (beside,) if e))
        drawn = axes.imshow(shown, aspect="auto", cmap=SEQUENTIAL, vmin=np.log10(0.3), vmax=top, interpolation="nearest")
        step = max(1, R // 24)
        axes.set_yticks(range(0, R, step), row_labels(evidence, order)[::step])
        axes.set_xlabel("harmonic of the drive (0: mean)")
        bar = figure.colorbar(drawn, cax=figure.add_axes([0.875, 0.62 / height, 0.012, 1 - 0.67 / height]))
        ticks = [t for t in (-0.5, 0, 0.5, 1, 1.5, 2, 2.5, 3, 4) if np.log10(0.3) <= t <= top]
        bar.set_ticks(ticks, labels=[plain(10.0**t, 2) for t in ticks])
        bar.set_label("misfit / noise of the line")
        caption = "Amplitude of each harmonic of the misfit over its noise; about 1 everywhere where only noise is left."
        where = f"The largest is {plain(ratio[worst])} at harmonic {worst[1]} of {evidence['name'][worst[0]]} ({plain(evidence['frequency'][worst[0]], 4)} Hz)."
        return picture(figure, stem, title, f"{caption} {where}")


def traces(evidence, stem: str = "traces"):
    """The residual along each record, one trace a recording, like a seismogram."""
    chosen = [int(k) for k in evidence["chosen"]]
    values = [evidence["trace"][str(k)]["value"] for k in chosen]
    spacing = max(8.0, 1.6 * float(np.quantile(np.abs(np.concatenate(values)), 0.98)))
    height = 0.9 + 0.36 * len(chosen)
    with styled():
        figure = canvas(WIDTH, height)
        axes = figure.add_axes([0.16, 0.5 / height, 0.80, 1 - 0.6 / height])
        for row, (k, value) in enumerate(zip(chosen, values, strict=True)):
            at = evidence["trace"][str(k)]["periods"]
            axes.axhspan(-row * spacing - 2, -row * spacing + 2, color=PALE, lw=0, alpha=0.7)
            axes.plot(at, value - row * spacing, color=BLUE if row % 2 == 0 else INK, lw=0.7)
        axes.set_yticks([-r * spacing for r in range(len(chosen))], row_labels(evidence, chosen))
        axes.set_xlabel("time / periods of the drive")
        axes.set_xlim(0, max(evidence["trace"][str(k)]["periods"][-1] for k in chosen))
        top = max(0.6 * spacing, max(float(v.max()) - r * spacing for r, v in enumerate(values)) + 1)
        bottom = min(-(len(chosen) - 0.4) * spacing, min(float(v.min()) - r * spacing for r, v in enumerate(values)) - 1)
        axes.set_ylim(bottom, top)
        worst = max(float(np.abs(v).max()) for v in values)
        caption = (
            "Residual along each record in units of its noise (means of short blocks); the bands are ± 2, where nineteen of twenty blocks "
            f"of white noise lie. The largest excursion is {plain(worst)}."
        )
        return picture(figure, stem, "Residual against time", caption)


def against(evidence, stem: str = "against"):
    """The residual against field and rate, by branch, and chi2/N against frequency."""
    terms = terms_in(evidence)
    with styled():
        figure = canvas(WIDTH, 2.9)
        axes = [figure.add_axes([0.065 + k / 3, 0.18, 0.255, 0.72]) for k in range(3)]
        rows = [evidence["against"][key][name] for key in ("field", "rate") for name in ("rising", "falling")]
        reach = 1.15 * max(float(np.nanmax(np.abs(row[0]) + 2 * row[1])) for row in rows)
        for ax, key in zip(axes, ("field", "rate"), strict=False):
            _branches(ax, evidence["against"][key], key, terms)
            ax.set_ylim(-reach, reach)
        inner = float(np.nanmedian(np.concatenate([0.5 * (row[3] - row[2]) for row in rows])))
        axes[0].legend(loc="best", handlelength=1.6)
        axes[0].set_ylabel("residual / noise of a sample")
        frequency, chi2 = evidence["frequency"], evidence["chi2"]
        # a recording has about 81 numbers: three standard deviations of chi2/N
        axes[2].axhspan(max(1 - 3 * np.sqrt(2 / 81), 0.3), 1 + 3 * np.sqrt(2 / 81), color=PALE, lw=0)
        axes[2].plot(frequency, np.maximum(chi2, 1e-3), ls="", marker="o", ms=5, mfc="none", mec=VERMILION, mew=1.4)
        axes[2].set(
            xscale="log",
            xlabel="frequency / Hz",
            title="χ²/N of each recording",
            ylim=(min(0.4, chi2.min() / 1.3), max(3.0, chi2.max() * 1.4)),
        )
        axes[2].set_yscale("log")
        plain_ticks(axes[2], "xy")
        axes[0].set_title(f"against the {terms.applied}")
        axes[1].set_title("against its rate of change")
        caption = (
            f"Means of the residual with two standard errors, rising and falling branch apart; of single samples 90 % lie within ± {plain(inner, 2)}. "
            "Right: misfit of each recording against its frequency; the band is where noise alone would put it."
        )
        return picture(figure, stem, f"Residual against {terms.field}, rate and frequency", caption)


def _branches(axes, found, key, terms):
    edges = found["edges"]
    middle = 0.5 * (edges[1:] + edges[:-1]) if key == "field" else np.sqrt(edges[1:] * edges[:-1])
    scale, unit = terms.scaled(np.abs(edges).max() if key == "field" else 0.0)
    axes.axhline(0, color=MUTED, lw=0.5)
    for name, colour, marker in (("rising", BLUE, "o"), ("falling", VERMILION, "s")):
        mean, error = found[name][:2]
        axes.errorbar(
            scale * middle,
            mean,
            2 * error,
            color=colour,
            marker=marker,
            ms=3,
            lw=1,
            mfc="white" if name == "falling" else colour,
            label=name,
        )
    if key == "rate":
        axes.set_xscale("log")
        plain_ticks(axes, "x")
        axes.set_xlabel(f"|d{terms.field_letter}/dt| applied / ({terms.unit}/s)")
    else:
        axes.set_xlabel(f"{terms.applied} / {per(unit)}")


def plain_ticks(axes, which):
    """Numbers without exponents on logarithmic axes ("x", "y" or both)."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis, letter in ((axes.xaxis, "x"), (axes.yaxis, "y")):
        if letter in which:
            low, high = axis.get_view_interval()
            axis.set_major_locator(LogLocator(subs=(1.0,) if high / low > 30 else (1.0, 2.0, 5.0)))
            axis.set_major_formatter(FuncFormatter(lambda v, _: plain(v)))
            axis.set_minor_formatter(NullFormatter())


def autocorrelation(evidence, stem: str = "autocorrelation"):
    """Autocorrelation of the residual and of the noise alone, with the band of white noise."""
    found = evidence["autocorrelation"]
    band = float(found["band"])
    outside, alone = (plain(100 * float(np.mean(np.abs(found[key]) > band)), 2) for key in ("residual", "noise"))
    with styled():
        figure = canvas(WIDTH, 2.5)
        axes = figure.add_axes([0.08, 0.2, 0.88, 0.77])
        axes.axhspan(-band, band, color=PALE, lw=0)
        axes.axhline(0, color=MUTED, lw=0.5)
        axes.plot(found["lag"], found["noise"], color=MUTED, lw=0.9, ls=(0, (3, 2)), label="between the harmonics (noise alone)")
        axes.plot(found["lag"], found["residual"], color=VERMILION, lw=1.2, label="residual of the fit")
        reach = max(4 * band, 1.15 * float(np.abs(found["residual"]).max()), 1.15 * float(np.abs(found["noise"]).max()))
        axes.set(xlabel="lag / periods of the drive", ylabel="autocorrelation", xlim=(0, found["lag"][-1]), ylim=(-reach, reach))
        axes.legend(loc="upper right", ncols=2)
        caption = (
            f"Autocorrelation of the residual, mean over the recordings. The band holds 95 % of white noise. Outside it lie {outside} % of the lags of the "
            f"residual, and {alone} % of those of the noise alone, which need not be white: what the two lines share is the noise. A peak at whole periods "
            "that the noise does not have is a misfit that repeats with the drive."
        )
        return picture(figure, stem, "Autocorrelation of the residual", caption)


def spectrum(evidence, output: str, stem: str = "spectrum"):
    """Harmonics of reading and misfit against the noise floor, for the worst, the fastest and the slowest recording."""
    fine, unit = scale_of(output)[2:]
    lines = evidence["lines"]
    keys = sorted(lines["between"], key=lambda k: evidence["frequency"][int(k)])
    with styled():
        figure = canvas(WIDTH, 3.1)
        lowest = fine * 0.05 * float(np.nanmin(lines["floor"]))
        highest = fine * 3 * float(np.nanmax(lines["measured"][:, 1:]))
        for i, key in enumerate(keys):
            k = int(key)
            axes = figure.add_axes([0.07 + i * 0.315, 0.17, 0.285, 0.75])
            order = np.arange(lines["floor"].shape[1])
            between = lines["between"][key]
            axes.plot(between["order"], fine * between["amplitude"], color=PALE, lw=1.0, label="between harmonics")
            axes.plot(order, fine * lines["floor"][k], color=INK, lw=1.1, label="noise of a harmonic")
            axes.plot(
                order[1:], fine * lines["measured"][k, 1:], ls="", marker="o", ms=3.6, mfc="none", mec=MEASURED, label="measured"
            )
            axes.plot(order, fine * lines["misfit"][k], ls="", marker="D", ms=3.0, color=MODEL, mew=0, label="misfit")
            axes.set(yscale="log", xlim=(-0.5, order[-1] + 0.5), ylim=(lowest, highest), xlabel="harmonic of the drive")
            axes.set_title(f"{evidence['name'][k]}, {plain(evidence['frequency'][k], 4)} Hz", loc="left")
            plain_ticks(axes, "y")
            if i:
                axes.set_yticklabels([])
            else:
                axes.set_ylabel(f"amplitude / {unit}")
                axes.legend(loc="upper right", borderaxespad=0)
        caption = "Amplitudes of the harmonics of the reading and of the misfit against the noise floor of the same recording."
        return picture(figure, stem, "Spectrum: harmonics against the noise floor", caption)


STAGES = {
    "fit from negative": "from negative saturation",
    "fit from demagnetized": "from the demagnetized state",
    "fit from virgin": "from the state demagnetized before the bias",
    "fit from positive": "from positive saturation",
}  # start memories, in words


def convergence(history, stem: str = "convergence"):
    """chi2/N after each Jacobian, one line a stage."""
    stages = stages_of(history)
    colours = [BLUE, VERMILION, GREEN, ORANGE, SKY, INK]
    with styled():
        figure = canvas(WIDTH, 2.5)
        axes = figure.add_axes([0.08, 0.2, 0.64, 0.77])
        for k, (name, values) in enumerate(stages):
            at = np.arange(1, len(values) + 1)
            axes.plot(at, values, color=colours[k % 6], marker=MARKERS[k % 8], ms=3.5, mfc="white", lw=1.1, label=name)
        axes.axhline(1, color=MUTED, lw=0.6, ls=":")
        axes.set(yscale="log", xlabel="Jacobians of the stage", ylabel="χ²/N")
        low, high = min(min(v) for _, v in stages), max(max(v) for _, v in stages)
        axes.set_ylim(min(0.7, low / 1.3), max(3.0, high * 1.4))
        plain_ticks(axes, "y")
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1), borderaxespad=0)
        ends = "; ".join(f"{name}: {plain(v[0])} to {plain(v[-1])} in {len(v)}" for name, v in stages)
        return picture(figure, stem, "Convergence", f"Misfit after each Jacobian; the grey line is the noise. Stages: {ends}.")


def stages_of(history) -> list[tuple[str, list[float]]]:
    """The history cut where a stage begins anew, each in words: (name, chi2/N of its steps)."""
    stages: list[tuple[str, list[float]]] = []
    last = (None, 0)
    for text, step, chi2 in history:
        if chi2 is None or not chi2 > 0:
            continue
        if text != last[0] or step <= last[1]:
            stages.append((STAGES.get(text, text), []))
        stages[-1][1].append(chi2)
        last = (text, step)
    numbered, seen = [], {}
    for name, values in stages:
        seen[name] = seen.get(name, 0) + 1
        numbered.append((name if seen[name] == 1 else f"{name} ({seen[name]})", values))
    return numbered
