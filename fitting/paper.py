"""T&B's numbers: their loops (Figs. 7 and 8) with their constants, and their recipe (Fig. 6) run on such recordings."""

import json
from pathlib import Path

import numpy as np

from magjax.bench import load_bench
from magjax.simulate import simulate

from .demo import record
from .recipe import lag_recipe
from .report import figures, tables
from .report.page import part, render, section
from .result import write_atomically

FREQUENCIES = (10, 20, 50, 100, 150, 200, 300)
RANGES = ((-0.7, 0.9), (-0.7, 0.3))  # A, Figs. 7 and 8
MESH = np.arange(40.0, 105.0, 5.0)  # ohm


def run_paper(folder, seed: int = 0) -> dict:
    """Simulate, run the recipe on noisy recordings, write paper.json and paper.html; returns the content."""
    folder = Path(folder)
    actuator = load_bench("aa-050h").actuator()
    rng = np.random.default_rng(seed)
    phase = 2 * np.pi * np.arange(800) / 800
    families = {}
    for low, high in RANGES:
        current = 0.5 * (low + high) + 0.5 * (high - low) * np.sin(phase)
        families[f"[{low}, {high}] A"] = [
            (f, current, np.asarray(simulate(actuator, current, 1 / (800 * f), periodic=True).displacement)) for f in FREQUENCIES
        ]
    recordings = [record(actuator, f, 0.8, 0.1, rng, f"{f} Hz") for f in FREQUENCIES]
    table = lag_recipe(recordings, actuator, MESH)
    content = {"recipe": table.as_dict(), "truth": {"R_eddy": float(actuator.coil.R_eddy), "xi": float(actuator.mechanics.xi)}}
    message = f"the recipe picks R_eddy = {table.R_eddy:g} ohm and xi = {table.damping_ratio:.4f}; put in were 70 ohm and 0.7783"
    content["message"] = message
    write_atomically(folder / "paper.json", json.dumps(content, indent=1))
    rows = [
        [f"{R:g}", *(f"{x:.4f}" for x in row), f"{v:.2e}"]
        for R, row, v in zip(table.resistances, table.xi, table.variance, strict=True)
    ]
    note = "The density is an assumption: Fig. 5 gives no numbers."
    head = ["R_eddy / ohm", *(f"{f:g} Hz" for f in table.frequencies), "variance"]
    sections = [
        section("Loops with the paper's constants", part(text=note, picture=figures.paper_loops(families))),
        section(
            "ξ against frequency for each R_eddy",
            part(picture=figures.lag_table(table)),
            part(table=tables.table("ξ by R_eddy", head, rows)),
        ),
    ]
    headline = f"R_eddy = {table.R_eddy:g} ohm, ξ = {table.damping_ratio:.4f}"
    page = {
        "title": "Tan and Baras, Sec. 2.3",
        "facts": "Bench aa-050h.",
        "tone": "good",
        "headline": headline,
        "message": [message + "."],
        "sections": sections,
    }
    render(folder / "paper.html", page, f"magjax demo --paper --out {folder} --seed {seed}")
    return content
