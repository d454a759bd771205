"""Finer densities: which hats and cells may follow those of a fit, and from which misfit on."""

import dataclasses

CELLS = tuple({"knots": None, "cells": cells} for cells in (30, 40))  # a mass a cell: a rough density may need them
FINER = (  # densities tried where the misfit asks for them, those of one step side by side
    ({"knots": (26, 18)},),
    ({"knots": (36, 24)}, *CELLS),
    ({"knots": (48, 32)},),
)
FINER_MATERIAL = (  # where the field is known loops are steep, and cells too wide
    ({"knots": (26, 18), "level": 144},),
    ({"knots": (36, 24), "level": 144},),
    (),
)
FINER_FROM = (1.05, 1.5, 2.0)  # chi2/N from which each step is tried,
FINER_TAKES = (0.7, 0.5, 0.5)  # and the share of the excess that it may leave
STEPS_FROM = 1.05  # chi2/N from which steps of the density are allowed for on the hats of the second step,
STEPS_ON = (26, 18)  # and the hats from which on they are: on coarser ones they have no room
CELLS_MEET = 1.25  # chi2/N that cells must reach too: they take up physics, but not all of it
REFINE_BELOW = 8.0  # chi2/N above which it is physics that is missing
FINEST_BELOW = 30.0  # the same of the finest hats
REFINE_BESIDE = 30.0  # the same beside an effect: what it leaves may well be the density
REFINE_MATERIAL = 100.0  # instead of 8 where the field is known: steep loops ask for finer hats from far off


def on(choices, **density):
    """The choices with another density, of which nothing is known yet."""
    return dataclasses.replace(choices, stiffness=None, **density)


def finer_than(choices, bench) -> tuple:
    """The densities that may be tried after that of `choices`, those of one step side by side; () for steps that it has taken."""
    steps = FINER if bench.drive == "current" else FINER_MATERIAL
    steps = tuple(tuple(on(choices, **row) for row in step) for step in steps)
    if choices.knots is None:
        return ((),) * len(steps)
    taken = [any(row.knots is not None and row.knots <= choices.knots for row in step) for step in steps]
    return tuple(() if done else step for step, done in zip(steps, taken, strict=True))


def hats_of_step(choices, bench, step: int) -> tuple:
    """The hats of a step of `FINER`; () where these have been taken, and for cells."""
    return tuple(row for row in finer_than(choices, bench)[step] if row.knots is not None)


def has_steps(choices, bench) -> bool:
    """Whether a fit of this density may give it steps (`steps.stepped`)."""
    return bench.drive == "current" and choices.knots is not None and choices.knots >= STEPS_ON


def in_words(choices) -> str:
    """Of what a density is made."""
    if choices.rest == "held":
        return "masses that are held"
    steps = "" if choices.stiffness is None else ", a roughness weight for each of their differences"
    if choices.knots is None:
        return f"masses of cells, {choices.cells or choices.level} along the plane{steps}"
    return f"hats on {choices.knots[0]} x {choices.knots[1]} knots{steps}"


def finest(choices) -> bool:
    """Whether no finer hats are tried than those of `choices`."""
    return choices.knots is not None and choices.knots >= FINER[-1][0]["knots"]


def cells_beside(choices) -> tuple:
    """Densities of a mass a cell to set beside one of hats; () where it is of cells itself."""
    return () if choices.knots is None else tuple(on(choices, **row) for row in CELLS)


def finer_hats(choices) -> tuple:
    """The next finer hats; () after the finest, and where the density is of cells."""
    rows = (row for step in FINER for row in step if row["knots"] is not None and choices.knots is not None)
    return tuple(on(choices, **row) for row in rows if row["knots"] > choices.knots)[:1]
