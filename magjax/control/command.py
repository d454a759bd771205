"""What `magjax control` does: design, simulate, compare, and T&B Figs. 13-15."""

import dataclasses
import json
from pathlib import Path

import numpy as np

from ..errors import ConfigurationError
from ..inverse.command import write_table
from .l1 import TrackingProblem, design, knee
from .problem import M_S, rod, weight
from .realize import reduced_controller
from .tracking import STRATEGIES, aperiodic, compare, perturbed, sinusoid, track


def _problem(plant, options, **changed):
    stroke = 1e6 * plant.l_rod * plant.lambda_s
    stated = {
        "r_bar": getattr(options, "r_bar", 30.0),
        "w_bar": getattr(options, "w_bar", 0.1),
        "u_bar": options.u_bar,
        "T": options.T,
    }
    c_w = changed.pop("c_w", getattr(options, "c_w", 6.53e-13))
    return TrackingProblem(plant=rod(plant.f0, plant.xi, options.T, stroke), weight=weight(c_w * M_S**2), **{**stated, **changed})


def design_summary(plant, options, folder) -> dict:
    """Design, reduce, print margins; write design.json (and the figures)."""
    made = design(_problem(plant, options), options.taps)
    controller = reduced_controller(made)
    margins = controller.margins()
    K = controller.to_control()
    summary = {
        "gamma_um": made.gamma, "lower_um": made.lower, "gap": made.gap, "norms": made.norms, "order": controller.order,
        "reduced_gamma_um": controller.gamma, "hard_rows_broken": controller.breaks(), "margins": dataclasses.asdict(margins),
        "Q": [float(q) for q in made.Q], "K": {k: np.asarray(getattr(K, k)).tolist() for k in "ABCD"},
        "T": options.T, "seconds": made.seconds,
    }  # fmt: skip
    poles = np.abs(np.linalg.eigvals(np.asarray(K.A)))
    warning = (
        " K itself has poles on the unit circle: it winds up; keep its anti-windup or lower u_bar."
        if len(poles) and poles.max() > 1 - 1e-4
        else ""
    )
    if margins.delay == 0:
        warning += " One extra sample of delay destabilizes the loop."
    summary["message"] = (
        f"gamma* = {made.gamma:.6g} um (certified to a relative gap of {made.gap:.1e}); control at most {made.control:.4g} M_s^2; controller of "
        f"order {controller.order} on its model; {margins}.{warning}"
    )
    if folder is not None:
        _write_json(folder / "design.json", summary)
        if options.figures:
            summary["figures"] = str(design_figures(plant, options, folder))
            summary["message"] += f" Wrote {folder}/design.json and {summary['figures']}."
        else:
            summary["message"] += f" Wrote {folder}/design.json."
    elif options.figures:
        raise ConfigurationError("--figures needs a folder; add --out DIR")
    return summary


def _write_json(path, content):
    partial = path.with_name(path.name + ".part")
    partial.write_text(json.dumps(content, indent=1), encoding="utf-8")
    partial.replace(path)


def design_figures(plant, options, folder) -> Path:
    """T&B Figs. 13-15: gamma* against uncertainty, inversion error and saturation."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    c_ws = np.linspace(0.2, 6.0, 13) * 1e-11
    w_bars = np.linspace(0.02, 0.3, 12)
    u_bars = np.concatenate([np.linspace(0.25, 4.0, 12), np.linspace(4.25, 7.5, 6)])
    curves = [
        (
            c_ws,
            [design(_problem(plant, options, c_w=c, u_bar=7.5), 40).gamma for c in c_ws],
            "c_w, um per (A/m)$^2$",
            "Fig. 13: model uncertainty",
        ),
        (
            w_bars,
            [design(_problem(plant, options, w_bar=w, u_bar=1.25), 40).gamma for w in w_bars],
            "w_bar, $M_s^2$",
            "Fig. 14: inversion error",
        ),
        (u_bars, [design(_problem(plant, options, u_bar=u), 40).gamma for u in u_bars], "u_bar, $M_s^2$", "Fig. 15: saturation"),
    ]
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    for ax, (x, y, label, title) in zip(axes, curves, strict=True):
        ax.plot(x, y, "o-", ms=3, color="#1f5c99")
        ax.set(xlabel=label, title=title)
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("gamma*, um")
    try:
        reach = knee(_problem(plant, options))[0]
        axes[2].axvline(reach, color="0.5", ls=":", label=f"knee {reach:.3g} (T&B: about 4.5)")
        axes[2].legend(fontsize=8)
    except ConfigurationError:  # no closed form where the sampled rod is not minimum phase
        axes[2].set_title("Fig. 15: saturation (no closed-form knee)")
    figure.suptitle(
        f"l1 designs with the printed constants and an assumed hold at T = {options.T * 1e3:g} ms (the paper does not state T)",
        fontsize=10,
    )
    path = folder / "l1_figures.png"
    figure.savefig(path, dpi=130)
    plt.close(figure)
    return path


def simulate_summary(plant, options, columns=None) -> dict:
    """One strategy on one trajectory, written as CSV."""
    from ..inverse.command import read_trajectory

    if options.trajectory in ("sine", "aperiodic"):
        time, wanted = (sinusoid if options.trajectory == "sine" else aperiodic)(plant, options.T)
    else:
        time, wanted = read_trajectory(Path(options.trajectory), columns)
    run = track(plant, plant, time, wanted, options.strategy, options.u_bar)
    rms, largest = run.errors()
    out = Path(options.out)
    write_table(out, [run.time, run.wanted, run.reached, run.current], "time_s,wanted_m,reached_m,current_A")
    text = f"{options.strategy} at T = {time[1] - time[0]:.4g} s: rms error {rms * 1e6:.3g} um, largest {largest * 1e6:.3g} um, "
    text += f"{run.saturated:.0%} of the samples at a limit; wrote {out}"
    return {"rms_m": rms, "largest_m": largest, "saturated": run.saturated, "file": str(out), "message": text}


HIDDEN = {"amplifier_lag": {"tau": 4e-4}, "quartic_magnetostriction": {"b": 0.25}}
NOISE_M = 2e-7  # of the reading in the table's noisy rows


def compare_summary(plant, options, folder, benches=None) -> dict:
    """The tracking table. `benches()`: models before and after a diagnosis, the plant itself, and what was found."""
    wrong = perturbed(plant, seed=options.seed)
    plants = {
        "nominal": (plant, plant),
        "fit errors": (plant, wrong),
        f"fit errors, {NOISE_M * 1e6:g} um noise": (plant, wrong, NOISE_M),
    }
    found = {}
    if benches is not None:
        before, after, true, found = benches()
        plants["concealed, before diagnosis"] = (true, before)
        plants["concealed, after repair"] = (true, after)
    rows = compare(plants, options.T)
    lines = ["| plant | trajectory | " + " | ".join(STRATEGIES) + " |", "|---|---|" + "---|" * len(STRATEGIES)]
    for name in plants:
        for shape in dict.fromkeys(r["trajectory"] for r in rows):
            part = {r["strategy"]: r for r in rows if r["plant"] == name and r["trajectory"] == shape}
            lines.append(f"| {name} | {shape} | " + " | ".join(f"{part[s]['rms_m'] * 1e6:.2f}" for s in STRATEGIES) + " |")
    text = "rms tracking error, um, after the first quarter:\n\n" + "\n".join(lines)
    if found:
        text += f"\n\nConcealed: {options.hide} {HIDDEN[options.hide]}; the diagnosis: {found['message']}"
    summary = {"rows": rows, "diagnosis": found, "message": text}
    if folder is not None:
        _write_json(folder / "study.json", summary)
        _tracking_figure(plants, options, folder)
        summary["message"] += f"\n\nWrote {folder}/study.json and {folder}/tracking.png."
    return summary


def _tracking_figure(plants, options, folder):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    shown = [(strategy, "nominal") for strategy in STRATEGIES[:4]] + [(STRATEGIES[4], "fit errors")]
    figure, axes = plt.subplots(3, len(shown), figsize=(16, 7), sharex=True, layout="constrained", height_ratios=(2, 1, 1))
    for column, (strategy, name) in enumerate(shown):
        plant, model, *_ = plants[name]
        time, wanted = sinusoid(plant, options.T)
        run = track(plant, model, time, wanted, strategy, options.u_bar)
        axes[0, column].plot(time, wanted * 1e6, color="0.6", lw=2, label="wanted")
        axes[0, column].plot(time, run.reached * 1e6, color="#1f5c99", lw=1, label="reached")
        axes[0, column].set_title(strategy.replace("_", " ") + ("" if name == "nominal" else f" ({name})"))
        axes[1, column].plot(time, (run.reached - wanted) * 1e6, color="#b03a2e", lw=0.8)
        axes[2, column].step(time, run.current, color="#2e7d32", lw=0.8, where="post")
        axes[2, column].set_xlabel("time, s")
        for ax in axes[:, column]:
            ax.grid(alpha=0.3)
    for row, label in enumerate(("displacement, um", "error, um", "current, A")):
        axes[row, 0].set_ylabel(label)
    axes[0, 0].legend(fontsize=8)
    figure.suptitle("Tracking 20 Hz (compare T&B Figs. 10, 16 and 19)", fontsize=10)
    figure.savefig(folder / "tracking.png", dpi=100)
    plt.close(figure)


def bounds_summary(plant, options) -> dict:
    """Propositions 4.1-4.3 beside a simulated worst case of scheme (10)."""
    from ..inverse.bounds import backward_bound, forward_bound, simulated_worst, static_bound

    lines, summary = [], {}
    static = static_bound(plant, delta_I=options.delta_I)
    summary["4.1"] = {"bound_A_per_m": static.value, "share_of_M_s": static.share, "note": static.note}
    lines.append(
        f"Prop. 4.1, masses off by {options.delta_I:g}: |e_M| <= {static.value:.4g} A/m "
        f"({static.share:.3g} of the summed masses){_noted(static.note)}"
    )
    for name, maker, forward in (("4.2", forward_bound, True), ("4.3", backward_bound, False)):
        try:
            bound = maker(plant, options.T)
        except ConfigurationError as error:
            if not forward:
                raise
            summary[name] = {"note": str(error)}
            lines.append(f"Prop. {name}: {error}")
            continue
        worst = simulated_worst(plant, options.T, bound.g_bar, forward, seed=options.seed)
        summary[name] = {
            "bound_A_per_m": bound.value,
            "share_of_M_s": bound.share,
            "g_bar": bound.g_bar,
            "simulated_A_per_m": worst,
            "note": bound.note,
        }
        lines.append(
            f"Prop. {name}, T = {options.T:g} s: |e_M| <= {bound.value:.4g} A/m ({bound.share:.3g} of the summed masses) "
            f"at g_bar = {bound.g_bar:.3g}; "
            f"simulated worst {worst:.4g} A/m ({worst / plant.operator.total:.3g} of them){_noted(bound.note)}"
        )
    summary["message"] = "\n".join(lines)
    return summary


def _noted(note: str) -> str:
    return f"; {note}" if note else ""
