"""The figures of the reports, by matplotlib: each is written as SVG (for the page) and PNG beside it."""

import numpy as np

from ..joint import data_residual
from ..spectra import evaluate_lines

INK, MEASURED, MODEL, BAD = "#222222", "#1f6fb4", "#d1495b", "#d1495b"


def _plotting():
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False, "svg.fonttype": "path", "figure.dpi": 110})
    return plt


def _units(result):
    displacement = result.bench.output == "displacement"
    return (1e6, "displacement / µm") if displacement else (1.0, f"{result.bench.output.replace('_', ' ')} / T")


def _model_lines(result):
    problem = result.problem
    residual = data_residual(problem, result.solution.z)
    R, H = problem.target.lines.shape
    misfit = residual[: R * H].reshape(R, H).astype(complex)
    misfit[:, 1:] += 1j * residual[R * H :].reshape(R, H - 1)
    deviation = np.where(np.isfinite(problem.target.deviations), problem.target.deviations, 0.0)
    return misfit * deviation


def loops(result, folder, stem="loops", title="measured and fitted loops"):
    """Measured against fitted loops, a residual strip below each."""
    plt = _plotting()
    factor, label = _units(result)
    misfit = _model_lines(result)
    spectra = result.problem.spectra[:12]
    columns = min(4, len(spectra))
    rows = int(np.ceil(len(spectra) / columns))
    figure, axes = plt.subplots(2 * rows, columns, figsize=(2.7 * columns, 3.1 * rows), height_ratios=[3, 1] * rows, squeeze=False, layout="constrained")
    phases = np.arange(401) / 400
    for k, s in enumerate(spectra):
        upper, lower = axes[2 * (k // columns)][k % columns], axes[2 * (k // columns) + 1][k % columns]
        drive = s.drive_at(phases)
        measured = evaluate_lines(s.reading, phases)
        model = measured + evaluate_lines(misfit[k], phases)
        upper.plot(drive, factor * measured, color=MEASURED, lw=1.6, label="measured")
        upper.plot(drive, factor * model, color=MODEL, lw=0.8, ls="--", label="fitted")
        upper.set_title(f"{s.frequency:.4g} Hz, chi2/N {result.recordings[k].chi2_per_sample:.2f}", fontsize=8)
        lower.plot(phases, 1e9 * (model - measured) if factor == 1e6 else model - measured, color=INK, lw=0.6)
        lower.axhline(0, color="0.7", lw=0.5)
        lower.set_xlabel("period")
        if k % columns == 0:
            upper.set_ylabel(label)
            lower.set_ylabel("fit − meas. / nm" if factor == 1e6 else "fit − meas. / T")
    for k in range(len(spectra), rows * columns):
        axes[2 * (k // columns)][k % columns].axis("off")
        axes[2 * (k // columns) + 1][k % columns].axis("off")
    axes[0][0].legend(frameon=False, fontsize=7)
    figure.suptitle(f"{title}, against {'current / A' if result.bench.drive == 'current' else 'applied field / (A/m)'}")
    return _save(plt, figure, folder, stem)


def mass_map(result, folder, stem="masses"):
    """The density on the Preisach plane; cells that no recording switches are hatched."""
    plt = _plotting()
    from ..uncertainty import visited_cells

    hysteresis = result.actuator.hysteresis
    masses = np.asarray(hysteresis.masses)[1:, 1:]
    levels = np.asarray(hysteresis.levels)[1:] / 1e3
    seen = visited_cells(result.actuator, result.spectra)[1:, 1:]
    shown = np.ma.masked_where(~np.tril(np.ones_like(seen)), masses)
    figure, ax = plt.subplots(figsize=(4.6, 3.9), layout="constrained")
    extent = (levels[0], levels[-1], levels[0], levels[-1])
    top = np.quantile(masses[masses > 0], 0.995) if (masses > 0).any() else 1.0
    picture = ax.imshow(shown, origin="lower", extent=extent, cmap="viridis", vmin=0, vmax=top, interpolation="nearest")
    unseen = (~seen & np.tril(np.ones_like(seen))).astype(float)
    if unseen.any():
        ax.contourf(unseen, levels=[0.5, 1.5], extent=extent, hatches=["////"], colors="none")
    figure.colorbar(picture, label="mass a cell / (A/m)")
    ax.set(xlabel="β / (kA/m)", ylabel="α / (kA/m)", title="Preisach masses (hatched: never switched)")
    return _save(plt, figure, folder, stem)


def misfit_map(result, folder, stem="misfit"):
    """Misfit over its noise by recording and harmonic."""
    plt = _plotting()
    R, H = result.problem.target.lines.shape
    residual = data_residual(result.problem, result.solution.z)
    power = residual[: R * H].reshape(R, H) ** 2
    power[:, 1:] = 0.5 * (power[:, 1:] + residual[R * H :].reshape(R, H - 1) ** 2)
    order = np.argsort([s.frequency for s in result.problem.spectra])
    figure, ax = plt.subplots(figsize=(6.4, 0.6 + 0.24 * R + 0.6), layout="constrained")
    picture = ax.imshow(np.log10(np.maximum(power[order], 1e-2)), aspect="auto", cmap="magma", vmin=-1, vmax=max(2, np.log10(power.max())))
    figure.colorbar(picture, label="log10 (misfit/noise)²")
    ax.set_yticks(range(R), [f"{result.problem.spectra[k].frequency:.4g} Hz" for k in order])
    ax.set(xlabel="harmonic of the drive", title="where simulation and recording differ")
    return _save(plt, figure, folder, stem)


def ranking(diagnosis, folder, stem="ranking"):
    """Scores of the candidates."""
    plt = _plotting()
    rows = diagnosis.candidates[:14][::-1]
    figure, ax = plt.subplots(figsize=(5.6, 0.5 + 0.22 * max(len(rows), 3)), layout="constrained")
    ax.barh([c.name for c in rows], [abs(c.z) for c in rows], color=[MODEL if c.achieved_chi2_drop is not None else "0.7" for c in rows])
    ax.axvline(5.5, color=INK, lw=0.8, ls=":")
    ax.set(xlabel="score |z| (dotted: threshold; red: fitted for real)", title="the catalogue against the misfit")
    return _save(plt, figure, folder, stem)


def paper_loops(families, folder, stem="paper_loops"):
    """Displacement against current: name of the range -> list of (frequency, current, displacement)."""
    plt = _plotting()
    figure, axes = plt.subplots(1, len(families), figsize=(9, 3.8), sharey=True, layout="constrained")
    for ax, (name, loops_of) in zip(axes, families.items(), strict=True):
        for k, (f, current, y) in enumerate(loops_of):
            ax.plot(current, y * 1e6, color=plt.cm.viridis(k / len(loops_of)), lw=1, label=f"{f:g} Hz")
        ax.set(title=name, xlabel="current, A")
    axes[0].set_ylabel("displacement, um")
    axes[-1].legend(fontsize=7, loc="upper left")
    _save(plt, figure, folder, stem)


def lag_table(table, folder, stem="lag_table"):
    """xi against frequency for each R_eddy, as T&B Fig. 6."""
    plt = _plotting()
    figure, ax = plt.subplots(figsize=(6, 3.4), layout="constrained")
    for k, (R, row) in enumerate(zip(table.resistances, table.xi, strict=True)):
        picked = R == table.R_eddy
        ax.plot(table.frequencies, row, "o-", ms=3, lw=2.2 if picked else 0.8, color="black" if picked else plt.cm.viridis(k / len(table.xi)))
        if k % 2 == 0 or picked:
            ax.annotate(f"{R:g} ohm", (table.frequencies[0], row[0]), fontsize=6, textcoords="offset points", xytext=(-34, -2))
    ax.set(xlabel="frequency, Hz", ylabel="damping ratio xi", ylim=(0, 1.6), xlim=(-25, None))
    _save(plt, figure, folder, stem)


def _save(plt, figure, folder, stem):
    figure.savefig(folder / f"{stem}.png", dpi=140)
    path = folder / f"{stem}.svg"
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)
    return path
