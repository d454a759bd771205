"""One small fit of an invented bench, and the result folders of every kind that the reports are tested on."""

import dataclasses

import numpy as np
import pytest

from fitting.check import check_errors
from fitting.demo import concealed_actuator, record
from fitting.diagnose import Diagnosis
from fitting.fit import fit
from fitting.locate import where
from fitting.report import write_diagnosis, write_fit
from fitting.screen import Candidate
from fitting.setup import Choices
from magjax.bench import load_bench
from magjax.effects import CATALOGUE

SMALL = Choices(fine=250)
DRIVES = ((10, 0.8, 0.1), (80, 0.5, -0.2), (250, 0.6, 0.1))
NAME = "rec <b>&\"' 80Hz.csv"  # a file may be called so


@pytest.fixture(scope="session")
def bench():
    return load_bench("aa-050h")


@pytest.fixture(scope="session")
def runs(bench):
    """Recordings for the fit, and one to check it."""
    rng = np.random.default_rng(3)
    truth = concealed_actuator(bench)
    made = [record(truth, *d, rng, NAME if d[0] == 80 else f"rec_{d[0]:03d}Hz.csv") for d in DRIVES]
    return made, [record(truth, 150, 0.6, 0.0, rng, "check_150Hz.csv")]


@pytest.fixture(scope="session")
def fitted(runs, bench):
    return fit(runs[0], bench, choices=SMALL, refine=False)


@pytest.fixture(scope="session")
def poor(runs, bench, fitted):
    """The same stopped after two Jacobians: far above the noise, not converged."""
    return fit(runs[0], bench, choices=dataclasses.replace(SMALL, max_jacobians=2), refine=False)


def candidates():
    """The whole catalogue with invented scores, the first two fitted for real."""
    made = []
    for k, effect in enumerate(e for e in CATALOGUE if not e.record_level):
        z = 70.0 / (1 + k) ** 1.5
        tried = {"achieved_chi2_drop": 0.9 * z**2, "bic_change": 8 - 0.9 * z**2} if k < 2 else {}
        made.append(Candidate(effect.name, effect.block, z, 0.2 / (1 + k), 1e-3, {}, z**2, 1e-4, True, **tried))
    return tuple(made)


@pytest.fixture(scope="session")
def diagnoses(runs, bench, fitted, poor):
    """One `Diagnosis` of each verdict; the stopped fit stands for the plain model, the settled one for the repaired."""
    recordings, _ = runs
    ranked = candidates()
    names = [c.name for c in ranked[:2]]
    check = (
        {
            "file": "check_150Hz.csv",
            "channel": "displacement",
            "unit": "m",
            "rms_before": 3e-7,
            "rms_after": 5e-8,
            "noise_rms": 4e-8,
        },
    )
    common = {
        "candidates": ranked, "floors": {"noise_rms": 4e-8, "solver_rms": 1e-10, "density_rms": 2e-9},
        "where": where(poor, ranked, recordings, "displacement"), "check": check, "base": poor,
    }  # fmt: skip
    effect = {
        "name": names[0], "block": ranked[0].block, "parameters": {"tau": {"value": 1.23e-4, "stderr": 2e-6, "unit": "s"}}, "confidence": 0.97,
        "shifts": {"coil.R_eddy": [80.0, 62.0], "mechanics.xi": [0.9, 0.81]},
    }  # fmt: skip
    ask = {
        "text": f"four settled periods of 0.8 A at 500 Hz: separates {names[0]} from {names[1]}",
        "drive": {},
        "channels": ["the coil current by a shunt"],
        "separates": [[*names, 0.97]],
    }
    return {
        "attributed": Diagnosis(
            "attributed", f"{names[0]} (source) was left out.", (effect,), repaired=fitted, absorbed=(ranked[-1].name,), **common
        ),
        "group": Diagnosis(
            "group",
            "cannot tell apart.",
            (),
            (tuple(names),),
            rivals={names[1]: effect["parameters"]},
            next_experiment=ask,
            repaired=fitted,
            **common,
        ),
        "unknown_at": Diagnosis(
            "unknown_at",
            "unknown.",
            unknown={"block": "sensor", "region": "field quarter 1 of 4", "explained_share": 0.2},
            **common,
        ),
        "nothing_missing": Diagnosis("nothing_missing", "nothing is missing.", **{**common, "base": fitted}),
        "data_problem": Diagnosis(
            "data_problem", "rec_010Hz.csv: an unsettled transient.", data_problem="an unsettled transient", base=fitted
        ),
        "unsettled": Diagnosis("data_problem", "rec_010Hz.csv: an unsettled transient.", data_problem="an unsettled transient"),
        "unreadable": Diagnosis("data_problem", "rec.csv: displacement is clipped.", data_problem="clipped"),
    }


@pytest.fixture(scope="session")
def folders(tmp_path_factory, runs, fitted, poor, diagnoses):
    """Result folders by kind: fit, poor, and every verdict."""
    recordings, checks = runs
    made = {}
    for kind, result in {"fit": fitted, "poor": poor, **diagnoses}.items():
        made[kind] = folder = tmp_path_factory.mktemp(kind)
        content = result.as_dict()
        with pytest.MonkeyPatch.context() as patch:
            if kind not in WITH_PNG:
                patch.setattr("fitting.report.style.to_png", lambda figure: b"")
            if kind in ("fit", "poor"):
                held = checks if kind == "fit" else []
                content["check"] = check_errors(result.actuator, result.actuator, held, result.bench)
                write_fit(folder, result, recordings, content, "magjax fit rec_*.csv --bench aa-050h --out result", checks=held)
            else:
                known = recordings if kind != "unreadable" else []
                held = checks if result.check else ()
                write_diagnosis(folder, result, known, content, "magjax diagnose rec_*.csv --bench aa-050h", held)
    return made


WITH_PNG = ("fit", "group")  # a figure is drawn anew for it: two folders show that it is
KINDS = ("fit", "poor", "attributed", "group", "unknown_at", "nothing_missing", "data_problem", "unsettled", "unreadable")


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


@pytest.fixture
def html(folders, kind):
    return (folders[kind] / "report.html").read_text(encoding="utf-8")
