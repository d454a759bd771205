"""The verdict: what the search has reached, in one of six words and two or three plain sentences.

Order: what no repair meets is `unknown_at`; a repair that foretells the check recordings worse is not named; where nothing
earned its place the diagnosis is silent; what has rivals is a group, with the recording that tells them apart; the rest is
attributed. Data problems are told before any of this (`floors`).
"""

import dataclasses

import numpy as np

from magjax.words import sized

from .attribute import LIKE_DENSITY, MIN_DROP, MISFIT, ROUGH_CHI2, UNCONFIRMED_TIE, chi2_of, rivals_of, taken_back, taken_beside
from .check import check_errors, foretold_text
from .diagnosis import Diagnosis, Evidence, least_excess, misfit
from .experiments import INSTRUMENTS, instrument_request
from .instruments import exchange
from .rows import achieved, behind, creeps_on, found_rows, ties_of

Z_THRESHOLD = 5.5  # about forty columns are looked at
HALF = 0.5  # of the excess over NULL_CHI2 must be taken where the repair all but meets the noise
NULL_CHI2 = 0.95
FULL_SHARE = 0.96
CLEAN_CHI2, FULLER_SHARE = 1.5, 0.998  # from here on it must explain so much: right effects on smooth densities leave less
WELL_FORETOLD = (10.0, 0.05)  # misfit of a check recording from which, and the share of it up to which, FULL_SHARE is enough
DOMINANT = (
    0.9,
    5.0,
)  # share of a misfit from which an effect is named though it leaves some, if others leave so many times as much
SHOWN = (0.3, 2.0)  # of the check recordings' misfit, that an effect may leave which is named for that, or so much a recording
PROMISES = 8.0  # times the Newton decrement, that going on with a fit may gain at most
DOMINANT_TEXT = " What is left is the form of its law, or something weaker beside it: no other effect takes nearly as much."
LED_TEXT = " What is left is the form of their laws, or something weaker beside them: no other effect takes nearly as much as {}."
FOLLOWS = 0.7, 0.5  # share of what the dominant effect leaves, that those after it must take, and of its check recordings' misfit, to which they must lower that
CONFIRMED = (0.7, 1.0)  # of the check recordings' misfit that a name which they confirm may leave, or so much a recording
NO_BETTER = (3.0, 10.0, 0.8)  # chi2/N and check recordings' misfit from which what explains the one must lower the other to this share
WORSE = (1.1, 0.3)  # times the check recordings' misfit before, and more by so much a recording, that a repair may leave
AS_EXPECTED = 3.0  # chi2 per number of check recordings in units of what the fit expects to miss: there it errs as it says it does;
NEARER = (6.0, 0.3), (12.0, 0.1)  # or within this, and this share of the plain fit's
SETTLES = 50.0, 1.1  # chi2/N of a misfit and of all others' fits, and what one effect leaves that takes all of it: check recordings need not be met then
SAYS_FOR = 10.0  # what these then say for a repair, as a fall of chi2, though their errors rise
EXPECTED, AGAINST = 1.5, 0.1  # chi2 per number in these units, up to which a repair errs as it expects; share of its fall that they may speak against it
FORM_TEXT = " The model makes up for the form of its law by {}, which takes too little beside it to be named."
TAKEN_BACK_TEXT = " The model makes up for the form of the lag by a transport_delay below none: the two are one lag of another shape, late by {} in all."
CREEPS_TEXT = " The slow drift within the records, which was taken out of them, is the {} going on."
BEHIND_TEXT = " The mean levels, which take no part in the fit, are as far as the {} had come in each recording."
ZEROS_TEXT = " The reading's level changes from recording to recording by {} (rms) more than the model's; the means take no part in the fit."
FREE_TEXT = (
    " The recordings' mean levels take no part in the fit, for they differ from the model's by {} (rms): a zero that moves, or more of what is missing."
)
ROUGH_TEXT = " What is left above the noise is a density rougher than the fit's, most likely."
DENSITY_TEXT = "As a density does, {} takes some of it; it predicts the check recordings no better, so it is not named."
UNCHECKED_TEXT = "As a density does, {} takes some of it; only check recordings, at other amplitudes and offsets, could tell the two apart, so it is not named."
PLAIN_TEXT = "The model offered is the plain one, which predicts the check recordings better than any repair."
HIDDEN_TEXT = (
    " The fitted recordings alone do not show {}, for a density does nearly the same (chi2 falls by {:.0f}); it is named for the check recordings, "
    "which speak for it by {:.0f}."
)
UNSEEN = (  # constants that R_eddy and the density make up for
    "coil.c0", "coil.H_bias", "coil.N_m", "coil.A_m", "magnetostriction.lambda_s", "magnetostriction.l_rod",
)  # fmt: skip
FAR_FROM_NOISE = 10.0  # chi2/N that no repair may leave and still be called one


def too_little(reached, plain) -> str | None:
    """The names of effects that all but meet the noise and take less than half of what the plain fit leaves above it.

    What a rough density leaves looks like a weak effect, but no effect takes it up. One that scores is named beside it where check
    recordings bear it out.
    """
    if not reached.steps or not reached.current.chi2_per_sample < least_excess(plain):
        return None
    taken = plain.chi2_per_sample - reached.current.chi2_per_sample
    if taken > HALF * (plain.chi2_per_sample - NULL_CHI2) or _borne_out(reached, plain):
        return None
    return " and ".join(best.name for best, *_ in reached.steps)


def _borne_out(reached, plain) -> bool:
    """Whether check recordings say as much for the one effect found, which scores and is none that a density passes for, as an effect
    must take."""
    (best, *_), *more = reached.steps
    if more or not reached.foretell or best.name in LIKE_DENSITY or abs(best.candidate.z) < Z_THRESHOLD:
        return False
    says = reached.foretell.says_for(reached.current, plain)
    return says is not None and says > MIN_DROP


def verdict(evidence: Evidence, rough: bool = False) -> Diagnosis:
    """The `Diagnosis`. `rough`: what is left has been looked for and is put down to the density."""
    dropped = too_little(evidence.reached, evidence.plain)
    if dropped:
        evidence = dataclasses.replace(evidence, reached=dataclasses.replace(evidence.reached, current=evidence.plain, steps=[]))
    steps, current = evidence.reached.steps, evidence.reached.current
    raw, clean = evidence.checks
    rows = tuple(check_errors(evidence.raw.actuator, current.actuator, raw, evidence.bench, clean)) if raw else ()
    rows = tuple(evidence.reached.foretell.beside(rows, current)) if evidence.reached.foretell else rows
    common = {
        "floors": evidence.floors, "where": evidence.where, "absorbed": evidence.absorbed, "base": evidence.raw, "check": rows,
        "candidates": achieved(evidence), "repaired": current if steps or evidence.adopted else None,
        "cleaned_checks": tuple(clean) if evidence.adopted else (),
    }  # fmt: skip
    before, after = misfit(rows, "rms_before"), misfit(rows, "rms_after")
    foretold = before > WELL_FORETOLD[0] * len(rows) and after < WELL_FORETOLD[1] * before
    full = FULL_SHARE if evidence.excess < CLEAN_CHI2 or foretold else FULLER_SHARE
    # on check recordings, too, for a density bends to the wrong effect as to the right one
    alone = dominant(evidence) and (after <= max(SHOWN[0] * before, SHOWN[1] * len(rows)) or as_expected(evidence))
    full, led = min(full, DOMINANT[0]) if alone else full, ""
    if evidence.missing and not rough and (not steps or evidence.share < full or evidence.excess > FAR_FROM_NOISE):
        first = first_alone(evidence)
        if first is None:
            return _unknown(evidence, common)
        if not followed(evidence, first, after):
            return verdict(first)
        led = LED_TEXT.format(steps[0][0].name)
    worse = after > WORSE[0] * before + WORSE[1] * len(rows)
    far_off = evidence.plain.chi2_per_sample > NO_BETTER[0] and before > NO_BETTER[1] * len(rows)
    hardly = far_off and after > NO_BETTER[2] * before
    if steps and (worse or hardly) and not foretold_all_the_same(evidence, rough, hardly):  # a repair that foretells no better is not physics
        if density_alone(evidence):
            return _by_density(evidence, DENSITY_TEXT)
        how = "worse" if worse else "hardly better"
        return _unknown(evidence, common, f" The repair that fits best predicts the check recordings {how}, so it is not named.")
    if steps and not raw and density_alone(evidence):
        return _by_density(evidence, UNCHECKED_TEXT)
    if after > max(CONFIRMED[0] * before, CONFIRMED[1] * len(rows)):
        evidence = dataclasses.replace(evidence, reached=unconfirmed(evidence.reached))
    effects, groups, sizes, rivals = found_rows(evidence)
    if not effects and not groups:
        return _silent(evidence, common, dropped, rough)
    swap = exchange(current, evidence.bench, evidence.reached.form)
    if swap and swap[1] and not any("sensor_lag" in g for g in groups):
        effects = [e for e in effects if e["name"] != "sensor_lag"]
        groups.append(["sensor_lag", "second_mode"])
    asked = instrument_request({"source", "sensor"} if evidence.command_only else {"sensor"}) if swap else None
    if groups:
        found = _grouped(evidence, common | {"rivals": sizes, "ties": ties_of(evidence)}, effects, groups, rivals, swap, asked)
    else:
        found = _attributed(evidence, common, effects, swap, asked)
    form = _form(evidence.reached)
    for effect, _ in evidence.adopted:
        if effect.shapes.get("zeros"):
            slow = behind(effect, evidence)
            form += BEHIND_TEXT.format(slow) if slow else ZEROS_TEXT.format(sized("m", effect.amplitude, digits=2))
        elif (slow := creeps_on(effect, evidence)) and CREEPS_TEXT.format(slow) not in form:
            form += CREEPS_TEXT.format(slow)
    form += led or (DOMINANT_TEXT if alone and evidence.missing and not rough else "")
    for best, _, _, previous in steps:
        if best.name in evidence.reached.hidden:
            form += HIDDEN_TEXT.format(best.name, best.drop, evidence.reached.foretell.says_for(best.result, previous))
    return dataclasses.replace(found, message=found.message + form + (ROUGH_TEXT if rough else ""))


def _by_density(evidence, note) -> Diagnosis:
    """The verdict of a misfit that is put down to the density, with a `note` on the effects that took some of it."""
    reached = dataclasses.replace(evidence.reached, current=evidence.plain, steps=[], form=None)
    names = " with ".join(best.name for best, *_ in evidence.reached.steps)
    return verdict(dataclasses.replace(evidence, reached=reached), rough=True).noted(note.format(names))


def foretold_all_the_same(evidence, rough, hardly) -> bool:
    """Whether check recordings that a repair misses as far as before, or farther, do not refuse it; asked where they would alone,
    for it takes Jacobians of theirs. They do refuse what a density does as well, alone: nothing else speaks for it."""
    if (evidence.missing and not rough) or like_density(evidence):
        return False
    return as_expected(evidence) or settles(evidence) or (not hardly and not evidence.missing and hardly_against(evidence))


def like_density(evidence) -> bool:
    """Whether a density does as well what all effects that were found do."""
    return all(best.name in LIKE_DENSITY for best, *_ in evidence.reached.steps)


def density_alone(evidence) -> bool:
    """Whether what was found is what a density does as well, of a misfit that a rough one leaves, and nothing else that was fitted takes
    half of that: then it stands for the hats that do not follow it."""
    plain = evidence.plain
    others = [c.achieved_chi2_drop or 0.0 for c in evidence.reached.tried.values() if c.name not in LIKE_DENSITY]
    half = HALF * (chi2_of(plain) - NULL_CHI2 * plain.data_count)
    return like_density(evidence) and plain.chi2_per_sample < ROUGH_CHI2 and max(others, default=0.0) < half


def as_expected(evidence) -> bool:
    """Whether what was found errs on the check recordings as it expects, for cells that no recording switched, and these speak
    for it: the plain fit expected to err less, and was wrong."""
    foretell = evidence.reached.foretell
    if not foretell or foretell(evidence.reached.current) is None:
        return False
    now, before = (foretell(fit).whitened for fit in (evidence.reached.current, evidence.plain))
    near = now < AS_EXPECTED or any(now < min(most, share * before) for most, share in NEARER)
    return near and foretell.says_for(evidence.reached.current, evidence.plain) > SAYS_FOR


def settles(evidence) -> bool:
    """Whether one effect alone takes a large misfit down to the noise, none that was fitted in its place came anywhere near that, and
    the check recordings speak for it. What they are missed by as far as before, or farther, is then the density's, in cells that no
    recording switched.
    """
    reached, plain = evidence.reached, evidence.plain
    if not reached.foretell or len(reached.steps) != 1 or reached.partial:
        return False
    far, met = SETTLES
    nearest = min(_left_by_others(evidence, reached.steps[0][0].name), default=0.0) / plain.data_count
    if min(plain.chi2_per_sample, nearest) < far or reached.current.chi2_per_sample > met:
        return False
    return reached.foretell.says_for(reached.current, plain) > SAYS_FOR


def hardly_against(evidence) -> bool:
    """Whether the check recordings say next to nothing against what was found, though their errors rise: it errs on them as it
    expects, for cells that no recording switched, and what they speak against it is little beside its fall of chi2."""
    foretell, current, plain = evidence.reached.foretell, evidence.reached.current, evidence.plain
    if not foretell or foretell(current) is None or not foretell(current).whitened < EXPECTED:
        return False
    return foretell.says_for(current, plain) > -AGAINST * (chi2_of(plain) - chi2_of(current))


def _left_by_others(evidence, name) -> list[float]:
    """What the effects left that were fitted in the place of the one of this name, chi2."""
    tried = [c for c in evidence.reached.tried.values() if c.achieved_chi2_drop is not None and c.name != name]
    return [chi2_of(evidence.plain) - c.achieved_chi2_drop for c in tried]


def dominant(evidence) -> bool:
    """Whether the one effect found leaves far less than any other that was fitted in its place: what it leaves is then its
    law's form. Physics outside the catalogue is taken up by several effects, one about as well as the next."""
    steps, current = evidence.reached.steps, evidence.reached.current
    if len(steps) != 1 or evidence.reached.partial:  # others were not fitted then
        return False
    best, _, good, _ = steps[0]
    left = _left_by_others(evidence, best.name)
    # of trials that were ended early: what they might have come to
    left += [
        chi2_of(t.result) - PROMISES * t.result.solution.decrement for t in good if t.name != best.name and not t.result.converged
    ]
    noise = NULL_CHI2 * current.data_count
    return bool(left) and min(left) - noise > DOMINANT[1] * (chi2_of(current) - noise)


def first_alone(evidence) -> Evidence | None:
    """The evidence with the first of several effects alone, where it is `dominant`: those after it do not meet the noise, and
    make up for the form of its law. None elsewhere."""
    steps = evidence.reached.steps
    if len(steps) < 2:
        return None
    reached = dataclasses.replace(evidence.reached, current=steps[0][0].result, steps=steps[:1], form=None)
    first = dataclasses.replace(evidence, reached=reached)
    return first if dominant(first) and first.share >= DOMINANT[0] and first.excess < FAR_FROM_NOISE else None


def followed(evidence, first, after: float) -> bool:
    """Whether those after the dominant effect, `first`, take most of what it leaves, and the check recordings show it: then they are
    named beside it though the forms of their laws leave a misfit. `after`: the check recordings' misfit with all of them."""
    raw, clean = evidence.checks
    if not raw or evidence.excess - NULL_CHI2 > (1 - FOLLOWS[0]) * (first.excess - NULL_CHI2):
        return False
    rows = check_errors(evidence.raw.actuator, first.reached.current.actuator, raw, evidence.bench, clean)
    return bool(after < FOLLOWS[1] * misfit(rows, "rms_after"))


def _form(reached) -> str:
    """What is said of an effect that makes up for the form of the others' laws, "" where there is none."""
    if not reached.form:
        return ""
    late = taken_back(reached.current.actuator)
    if reached.form in late:
        return TAKEN_BACK_TEXT.format(sized("s", sum(late.values())))
    return FORM_TEXT.format(reached.form)


def unconfirmed(reached):
    """The same with more rivals to the effects found, where check recordings are missed as far with them as without."""
    steps = [
        (best, rivals_of(best, good, UNCONFIRMED_TIE, taken_beside(reached.steps, k)), good, previous)
        for k, (best, _, good, previous) in enumerate(reached.steps)
    ]
    return dataclasses.replace(reached, steps=steps)


def asked_for(only) -> str:
    """Of which effects a verdict speaks, in words."""
    return f"asked for ({', '.join(only)})" if only else "of the catalogue"


def _silent(evidence, common, dropped, rough) -> Diagnosis:
    only, asked = evidence.only, [c.name for c in evidence.candidates]
    if only and asked and set(asked) <= set(evidence.absorbed):
        text = f"these recordings cannot tell whether {' or '.join(asked)} is there: a density that differs by a little does the same. "
        text += f"The fit stands at chi2/N = {evidence.excess:.2f} without it; another channel has to show it, the flux in a pick-up coil for one."
        return Diagnosis("absorbed", text, **common)
    text = f"no effect {asked_for(only)} was found{' by then' if evidence.reached.partial else ''}: chi2/N = {evidence.excess:.2f} and "
    if evidence.reached.partial:
        text += "what scores was not all fitted."
    elif dropped:
        text += f"{dropped}, which serves best, takes less than half of what is above the noise."
    else:
        best = evidence.candidates[0] if evidence.candidates else None
        highest = f"{best.name}, z = {best.z:.1f}" if best else "none"
        earned = "earned its place" if rough or (best and abs(best.z) > Z_THRESHOLD) else f"scores above {Z_THRESHOLD}"
        text += f"none {earned} (highest: {highest})."
    if rough:
        text += ROUGH_TEXT
    if evidence.absorbed:
        text += f" These recordings could not show {', '.join(evidence.absorbed)}: the density absorbs them."
    if len(evidence.recordings) == 1:
        text += " One recording tells little: record at other frequencies, amplitudes and offsets."
    held = [n.split(".")[1] for n in UNSEEN if n in evidence.bench.constants and n not in evidence.bench.free]
    if held and evidence.bench.drive == "current" and evidence.bench.output == "displacement":
        text += f" A wrong {', '.join(held[:-1])}{' or ' if held[1:] else ''}{held[-1]} in the bench file would not show here either: R_eddy and the density take it up."
    return Diagnosis("nothing_missing", text, **common)


def _grouped(evidence, common, effects, groups, rivals, swap, asked) -> Diagnosis:
    blocks = {t.candidate.block for t in rivals}
    between = bool(blocks & set(INSTRUMENTS)) and not blocks <= set(INSTRUMENTS)
    # where the noise is not met beside one instrument, the other is in question too
    also = INSTRUMENTS if between and evidence.excess > MISFIT and evidence.command_only else ()
    experiment = asked or (evidence.next_experiment(rivals, also) if rivals else None)
    names = "; ".join(" or ".join(g) for g in groups)
    number = {2: "two", 3: "three", 4: "four"}.get(len(groups[0]), "several")
    each = (
        f"{number} effects would each explain what is missing"
        if len(groups) == 1
        else "more than one effect explains what is missing"
    )
    text = f"{each}, and these recordings cannot tell them apart: {names}."
    text += " Not all rivals were fitted." if evidence.reached.partial else ""
    if effects:
        text += f" Found beside it: {', '.join(e['name'] for e in effects)}."
    if swap:
        text += f" {swap[0]} {_fall(evidence)}."
    elif between:
        text += " Instruments and actuator are not told apart by these channels."
    if experiment:
        text += f" Next: {experiment['text']}."
    return Diagnosis("group", text, tuple(effects), tuple(groups), next_experiment=experiment, **common)


def _attributed(evidence, common, effects, swap, asked) -> Diagnosis:
    named = " and ".join(f"{e['name']} ({e['block']})" for e in effects)
    better = foretold_text(common["check"])
    text = f"{named} {'was' if len(effects) == 1 else 'were'} left out: {_fall(evidence)}."
    text += " Not all rivals were fitted." if evidence.reached.partial else ""
    text += better or " Record a check at another frequency to confirm it."
    if swap:
        text += f" {swap[0]} To tell: {asked['text']}."
    return Diagnosis("attributed", text, tuple(effects), next_experiment=asked, **common)


def _fall(evidence) -> str:
    """What the repair does to the misfit, in words."""
    before, after = evidence.raw.chi2_per_sample, evidence.excess
    if not evidence.reached.steps and before < after + 0.2:
        one = len({effect.name for effect, _ in evidence.adopted}) == 1
        return f"{'it stands' if one else 'they stand'} between the harmonics, and chi2/N is {after:.2f} without"
    return f"chi2/N falls from {before:.3g} to {after:.2f}"


def unexplained(evidence, found) -> Diagnosis:
    """The `unknown_at` in place of a verdict that named an effect."""
    names = ("floors", "where", "absorbed", "base", "check", "candidates", "repaired", "cleaned_checks")
    return _unknown(evidence, {name: getattr(found, name) for name in names})


def without_worse(evidence, found) -> Diagnosis:
    """The diagnosis of an unknown without a repair that foretells the check recordings worse than the plain model: that one is offered."""
    if not found.repaired or misfit(found.check, "rms_after") <= misfit(found.check, "rms_before"):
        return found
    plain = evidence.plain
    raw, clean = evidence.checks
    rows = check_errors(evidence.raw.actuator, plain.actuator, raw, evidence.bench, clean)
    rows = evidence.reached.foretell.beside(rows, plain) if evidence.reached.foretell else rows
    return dataclasses.replace(found.noted(PLAIN_TEXT), check=tuple(rows), repaired=plain if evidence.adopted else None)


def _unknown(evidence, common, note: str = "") -> Diagnosis:
    blocks, fields = evidence.where["by_block"], evidence.where["by_field"]
    block = max(blocks, key=blocks.get) if blocks else "hysteresis"
    region = f"{evidence.bench.terms.field} quarter {int(np.argmax(fields)) + 1} of 4" if fields else ""
    steps = evidence.reached.steps
    best = steps[0][0].name if steps else (common["candidates"][0].name if common["candidates"] else "none")
    which = asked_for(evidence.only)
    nothing = f"that no effect {which} both explains and foretells" if note else f"that no effect {which} explains"
    nothing += ", of those that were fitted by then" if evidence.reached.partial else ""
    text = (
        f"something is missing {nothing} (chi2/N = {evidence.excess:.3g} at best; {best} comes nearest and explains "
        f"{max(evidence.share, 0):.0%} of the excess). It acts most like the block {block}, in {region}."
    )
    unknown = {"block": block, "region": region, "explained_share": float(np.clip(evidence.share, 0, 1))}
    # what the records alone show stands whatever the loops hold; means that were set free differ from those of a model that lacks something
    shown = tuple(pair for pair in evidence.adopted if not pair[0].shapes.get("zeros"))
    records = dataclasses.replace(evidence, adopted=shown, reached=dataclasses.replace(evidence.reached, steps=[]))
    effects, groups, sizes, _ = found_rows(records)
    if effects or groups:
        names = " and ".join([*(e["name"] for e in effects), *(" or ".join(g) for g in groups)])
        note += f" Found beside it, in what does not repeat with the drive: {names}."
    for effect in (e for e, _ in evidence.adopted if e.shapes.get("zeros")):
        note += FREE_TEXT.format(sized("m", effect.amplitude, digits=2))
    told = {"rivals": sizes, "ties": ties_of(records)} if groups else {}
    return Diagnosis("unknown_at", text + note, tuple(effects), tuple(groups), unknown=unknown, **(common | told))
