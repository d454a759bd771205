"""A diagnosis, the evidence that its verdict is read from, and the measures of a misfit that both share."""

import dataclasses
import re

import numpy as np

from .experiments import next_experiment
from .reach import beyond_text

MOST_NAMED = 3  # files of one error that are told by name
SILENT_CHI2 = 1.15  # above it something may be missing even where no single name stands out


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """The verdict with everything behind it; str() is the message."""

    verdict: str
    message: str
    effects: tuple = ()
    groups: tuple = ()
    rivals: dict = dataclasses.field(default_factory=dict)
    ties: dict = dataclasses.field(default_factory=dict)
    absorbed: tuple = ()
    unknown: dict | None = None
    data_problem: str | None = None
    candidates: tuple = ()
    floors: dict = dataclasses.field(default_factory=dict)
    where: dict = dataclasses.field(default_factory=dict)
    check: tuple = ()
    check_left_out: tuple = ()
    cleaned_checks: tuple = dataclasses.field(default=(), repr=False)  # recordings as the repaired model is held against, those left to check
    next_experiment: dict | None = None
    base: object = None
    repaired: object = None
    placebo: dict | None = None
    asked: tuple = ()  # the effects that alone were asked for, where these were named
    ended_after: float | None = None  # the limit, minutes, where it left something out

    def __str__(self):
        return f"{self.verdict}: {self._said()}"

    def noted(self, note: str) -> "Diagnosis":
        """The same with a further sentence."""
        return dataclasses.replace(self, message=f"{self.message} {note}")

    def parted(self, check) -> tuple[list, list]:
        """The check recordings that joined those of the fit, after them, and those that are left to check."""
        rows = list(zip(check, self.check, strict=False))  # a data problem has checked nothing
        joined = [c for c, row in rows if row.get("joined")]
        return joined, [c for c, row in rows if not row.get("joined")]

    def without_checks(self, refused) -> "Diagnosis":
        """The same with a word on check recordings that could not be used; `refused`: a sentence for each."""
        if not refused:
            return self
        noted = " ".join(f"Left out of the checks: {why}." for why in refused)
        return dataclasses.replace(self.noted(noted), check_left_out=tuple(refused))

    def _said(self) -> str:
        """The message, and where check recordings ask for more than was fitted."""
        return f"{self.message} {beyond_text(self.check)}".strip()

    def as_dict(self) -> dict:
        """The content of diagnosis.json."""
        ranked = [
            {
                "name": c.name, "z": c.z, "visibility": c.visibility, "amplitude": c.amplitude,
                "predicted_chi2_drop": c.predicted_chi2_drop, "achieved_chi2_drop": c.achieved_chi2_drop,
                "bic_change": c.bic_change, "smallest_visible": c.smallest_visible, "tried_at": c.tried_at,
            }
            for c in self.candidates
        ]  # fmt: skip
        return {
            "verdict": self.verdict, "effects": list(self.effects), "groups": [list(g) for g in self.groups],
            "rivals": self.rivals, "ties": self.ties, "absorbed": list(self.absorbed), "unknown": self.unknown, "data_problem": self.data_problem, "candidates": ranked,
            "floors": self.floors, "where": self.where, "check": list(self.check), "next_experiment": self.next_experiment,
            "placebo": self.placebo, "message": self._said(), "base": self.base.as_dict() if self.base else None,
            "repaired": self.repaired.as_dict() if self.repaired else None,
        } | {n: list(v) for n, v in (("check_left_out", self.check_left_out), ("asked", self.asked)) if v} | (
            {} if self.ended_after is None else {"ended_after": self.ended_after}
        )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Evidence:
    """What a verdict is read from.

    `reached`: what the search has (`search.Reached`); `adopted`: record-level effects, each with its rivals; `raw`: the plain
    fit of the readings as they came, `plain`: that of the readings without record-level signals (the same where there are
    none); `candidates`: the scores beside `plain`; `checks`: the check recordings as they came, and without those signals;
    `floors`, `where`, `absorbed`: as in `Diagnosis`; `only`: the effects that alone are asked for, where these are named;
    `experiments`: those that were asked for, by rivals.
    """

    reached: object
    adopted: tuple
    raw: object
    plain: object
    candidates: tuple
    recordings: tuple
    bench: object
    checks: tuple
    floors: dict
    where: dict
    absorbed: tuple
    only: tuple = ()
    experiments: dict = dataclasses.field(default_factory=dict)

    def next_experiment(self, rivals, also):
        """As `next_experiment`, of the same rivals once: a verdict is read anew beside other densities."""
        key = (also, *(id(t.result) for t in rivals))
        if key not in self.experiments:
            self.experiments[key] = rivals, next_experiment(rivals, self.raw.spectra, self.bench, also)
        return self.experiments[key][1]

    @property
    def excess(self) -> float:
        """chi2/N of what was reached."""
        return self.reached.current.chi2_per_sample

    @property
    def missing(self) -> bool:
        """Whether that is above the noise."""
        return self.excess > least_excess(self.plain)

    @property
    def share(self) -> float:
        """Of the plain fit's misfit, what the repair explains."""
        before = self.plain.chi2_per_sample
        return 1 - max(self.excess - 1, 0) / max(before - 1, 1e-9) if before > SILENT_CHI2 else 1.0

    @property
    def command_only(self) -> bool:
        """Whether the current that drives the model is a command nobody measured."""
        measured = all(r.origin.get("metadata", {}).get("current") == "measured" for r in self.recordings)
        return self.bench.drive == "current" and not measured


def unusable(errors, sound=()) -> Diagnosis:
    """The verdict over files that cannot be used, by their errors; `sound`: the recordings that can."""
    told = {}  # what is the same of several files but for its numbers is said once
    for error in map(str, errors):
        told.setdefault(re.sub(r"\d[\d.e+-]*", "", error.partition(": ")[2]) or error, []).append(error)
    text = " ".join(f"{first}{_and_so(others)}." for first, *others in told.values())
    if sound:
        others = "The other recording" if len(sound) == 1 else f"The other {len(sound)} recordings"
        text += f" {others} can be read and {'is' if len(sound) == 1 else 'are'} not clipped."
    return Diagnosis("data_problem", text, data_problem=str(errors[0]))


def _and_so(others) -> str:
    """That files with these errors have the same one, in words."""
    names = [error.partition(": ")[0] for error in others]
    which = f"{len(names)} other files" if len(names) > MOST_NAMED else " and ".join(names)
    return f" (the same of {which})" if names else ""


def misfit(rows, which: str) -> float:
    """Of check recordings above their noise: the sum of (rms / noise)^2 - 1. `which`: "rms_before" or "rms_after"."""
    return sum(max((r[which] / (r["noise_rms"] or r["rms_before"])) ** 2 - 1, 0.0) for r in rows)


def least_excess(result) -> float:
    """chi2/N above which a fit is not at its noise."""
    return SILENT_CHI2 + 3 * np.sqrt(2 / result.data_count)
