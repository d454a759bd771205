"""The screening's first-order columns against derivatives of the whole chain."""

import dataclasses
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import magjax.effects as effects
from fitting.demo import record
from fitting.model import predicted_lines, whitened
from fitting.nonparametric import Tangents, null_term
from fitting.screen import applicable, columns, shape_grid
from fitting.setup import START_WEIGHTS, Choices, build_problem, free_parameters, spectra_of
from magjax.bench import load_bench

SMALL = Choices(fine=128, coarse=90, knots=(6, 5), level=24, rest="negative")


@pytest.fixture(scope="module")
def recordings():
    rng = np.random.default_rng(0)
    return [record(load_bench("aa-050h").actuator(), f, 0.6, 0.05, rng, f"{f}") for f in (20.0, 200.0)]


ONE_OF_EACH = (effects.SecondEddyPath, effects.AmplifierLag, effects.StrainHysteresis)  # in the step, before it, behind it


@pytest.mark.parametrize(
    "kinds", [ONE_OF_EACH, pytest.param(effects.CATALOGUE, marks=pytest.mark.long)], ids=["one of each", "all"]
)
def test_are_those_of_the_whole_chain(recordings, kinds, monkeypatch):
    every = applicable
    monkeypatch.setattr("fitting.screen.applicable", lambda *a: [k for k in every(*a) if k in kinds])
    bench = load_bench("aa-050h")
    actuator = bench.actuator()
    for effect in (effects.SensorLag(tau=1e-4), effects.ExcessLoss(k=20.0)):
        actuator = actuator.with_effect(effect)
    spectra = spectra_of(recordings, bench, SMALL.harmonics)
    problem, z = build_problem(spectra, actuator, bench, free_parameters(bench, actuator, ()), SMALL, None)
    at = problem.layout.actuator(problem.template, jnp.asarray(z))
    target = eqx.tree_at(lambda t: t.lines, problem.target, jnp.zeros_like(problem.target.lines))
    found = {}
    for kind, shapes, column in columns(problem, z):
        found.setdefault(kind, []).append((shapes, column))
    asked = [k for k in applicable(actuator) if k in kinds and not k.record_level]
    assert set(found) == set(asked) and len(asked) > min(len(kinds) - 1, 20)
    small = [kind(**found[kind][-1][0]) for kind in asked if kind.amplitude not in found[kind][-1][0]]

    @jax.jit
    def changes(direction):  # one program for all: at their nulls the others change nothing
        def lines(sizes):
            changed = at
            for effect, size in zip(small, sizes, strict=True):
                changed = changed.with_effect(effect.with_amplitude(size))
            return predicted_lines(problem.predictors[0], changed)

        return jax.jvp(lines, (jnp.zeros(len(small)),), (direction,))[1]

    first_order = {effect.name: changes(e) for effect, e in zip(small, np.eye(len(small)), strict=True)}
    for kind in asked:
        # a limit that the rod's flux runs into: less flux then asks for less, which the first order leaves out
        shapes, column = [row for row in found[kind] if "linkage" not in row[0]][-1]
        assert len(found[kind]) == len(shape_grid(kind)) or kind.amplitude in shapes
        if kind.amplitude in shapes:  # scored at a finite size
            whole = predicted_lines(problem.predictors[0], at.with_effect(kind(**shapes))) - predicted_lines(problem.predictors[0], at)
        else:
            whole = first_order[kind.name]
        whole = np.asarray(whitened(whole, target))
        assert np.linalg.norm(whole) > 0
        near = 0.1 if kind is effects.AmplifierClipping else 1e-6  # all of the change of the drive, carried on to first order
        assert np.linalg.norm(column - whole) < near * np.linalg.norm(whole), kind.name


TERMS = (  # place, variables, whether in every run
    ("source", "current", False), ("coil", "flux_rate", False), ("coil", "magnetization current", True), ("hysteresis", "field", True),
    ("magnetostriction", "field", True), ("mechanics", "displacement", False), ("mechanics", "displacement displacement_direction", False),
    ("sensor", "reading", True), ("sensor", "reading reading_direction", True),
)  # fmt: skip


@pytest.fixture(scope="module")
def tangents(recordings):
    bench = load_bench("aa-050h")
    actuator, finer = bench.actuator(), dataclasses.replace(SMALL, fine=2 * SMALL.coarse)
    problem, z = build_problem(spectra_of(recordings, bench, SMALL.harmonics), actuator, bench, free_parameters(bench, actuator, ()), finer, None)
    return Tangents(SimpleNamespace(problem=problem, refined=SimpleNamespace(z=z, weights=np.array(START_WEIGHTS[: len(problem.penalties)]))))


@pytest.mark.parametrize(("place", "variables"), [pytest.param(p, v.split(), marks=() if often else pytest.mark.long) for p, v, often in TERMS])
def test_columns_of_a_learned_term_are_those_of_the_whole_chain(tangents, place, variables):
    """The places behind the hysteresis had been given the columns of the signal before each, and an unknown its block."""
    problem = tangents.problem
    term = null_term(place, tuple(variables), tangents.signals, tangents.actuator, (4, 1)[: len(variables)])
    predictor = problem.predictors[0 if place in ("source", "coil", "hysteresis") else 1]
    target = eqx.tree_at(lambda t: t.lines, problem.target, jnp.zeros_like(problem.target.lines))

    def lines(size):
        first = eqx.tree_at(lambda t: t.coefficients[1], term, size)
        return predicted_lines(predictor, tangents.actuator.with_effect(first))

    whole = np.asarray(whitened(jax.jit(lambda x: jax.jvp(lines, (0.0,), (x,))[1])(1.0), target))
    found = tangents.columns(term)[:, 1]
    assert np.linalg.norm(whole) > 0 and np.linalg.norm(found - whole) < 0.02 * np.linalg.norm(whole)
