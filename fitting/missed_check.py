"""Check recordings that are missed though the fit meets its noise: one joins the recordings, contradicts them, or is told of."""

import contextlib
import dataclasses

import numpy as np

from .attribute import MISFIT
from .diagnosis import Diagnosis, misfit
from .reach import BEYOND
from .spoilt import mended_by
from .task import Late
from .verdict import WORSE

MISSED = 5.0  # times its noise, by which a check recording is not foretold though the fit meets its own,
GROSS, ODDS = 0.1, 3.0  # of its range, and times what the fit expects, by which a check recording is missed that may be wrong itself
EXPECTED = 1.5  # beyond so many times what it expects for cells that no recording switched
UNSEEN_TEXT = "Check recordings are missed, times their noise: {}; about as the fit expects, for they switch cells that no recording did."


def with_missed_check(task, found, check, anew) -> Diagnosis:
    """The diagnosis; where the fit meets its noise and misses a check recording by far, that one joins the recordings, if
    others are left to check: what it shows they may not reach. What is named with it must foretell the others no worse.
    `anew(task, check)`: the diagnosis of a task's recordings.
    """
    known = found.verdict in ("attributed", "group", "nothing_missing") and not any(r.get("joined") for r in found.check)
    if not known or not check or len(found.check) != len(check):
        return found
    if not (found.repaired or found.base).chi2_per_sample < MISFIT:
        return found
    ratios = [_surprise(r) for r in found.check]
    if not max(ratios, default=0.0) > MISSED:
        return _with_unseen_cells(found)
    worst = int(np.argmax(ratios))
    missed, left = check[worst], [c for k, c in enumerate(check) if k != worst]
    name = missed.origin.get("file", missed.name).rsplit("/", 1)[-1]
    if why := _contradiction(found, found.check[worst], missed, task.bench):
        return found.noted(f"The check recording {name} contradicts the others: {why}; correct it or leave it out.")
    told = f"{name} is missed by {ratios[worst]:.0f} times its noise, though the fit meets its own"
    if not left:
        return found.noted(f"{told}: the recordings do not reach what it shows; give it as one of them, and others to check.")
    with contextlib.suppress(Late):
        task.sparing.say(f"with {name} among the recordings")
        again = anew(task.on(recordings=(*task.recordings, missed)), left)
    if task.clock.cut:
        return found.noted(f"{told}: there was no time to ask for what it shows beside the recordings.")
    rest = [r for k, r in enumerate(found.check) if k != worst]
    met = again.verdict in ("attributed", "group") and again.repaired.chi2_per_sample < MISFIT
    before, after = misfit(rest, "rms_after"), misfit(again.check, "rms_after")
    if not met or not _says_more(again, found) or after > WORSE[0] * before + WORSE[1] * len(rest):
        return found.noted(f"{told}: the recordings do not reach what it shows, a density or physics; record more like it.")
    row = {**found.check[worst], "rms_after": again.repaired.recordings[-1].residual_rms, "joined": True}
    again = dataclasses.replace(again, check=(*again.check[:worst], row, *again.check[worst:]))
    return again.noted(f"Without it among the recordings {told}; it joined them.")


def _contradiction(found, row, recording, bench) -> str | None:
    """What is wrong with a check recording that is missed grossly, in words; None where no one number mends it."""
    if not row["rms_after"] > max(GROSS * np.ptp(recording.channels[bench.output]), ODDS * (row.get("expected_rms") or 0.0)):
        return None
    return mended_by((found.repaired or found.base).actuator, recording, bench)


def _with_unseen_cells(found) -> Diagnosis:
    """The diagnosis with a word on check recordings within the plane that are missed by far, as the fit expects."""
    within = [r for r in found.check if r["noise_rms"] and r["beyond_plane"] <= BEYOND]
    rows = [(r["file"].rsplit("/", 1)[-1], r["rms_after"] / r["noise_rms"]) for r in within]
    far = [f"{name} by {ratio:.0f}" for name, ratio in rows if ratio > MISSED]
    return found.noted(UNSEEN_TEXT.format(", ".join(far))) if far else found


def _surprise(row) -> float:
    """How many times its noise a check recording is missed by; 0 where the fit expected as much, or its drive leaves the plane."""
    if not row["noise_rms"] or row["beyond_plane"] > BEYOND or row["rms_after"] < EXPECTED * (row.get("expected_rms") or 0.0):
        return 0.0
    return row["rms_after"] / row["noise_rms"]


def _says_more(again, found) -> bool:
    """Whether a diagnosis names more, or the same with fewer doubts."""
    number, before = (len(d.effects) + len(d.groups) for d in (again, found))
    return number > before or (number == before and len(again.groups) < len(found.groups))
