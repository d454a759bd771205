"""simulate(actuator, current, dt): the whole chain for one drive; sweep: a grid of frequencies, amplitudes and offsets.

Current (A), applied field (A/m) or voltage (V) in, every signal of the chain out, SI. Periodic drives end in their steady state, which is
judged: a small loop, or one at a high frequency, settles over tens of periods where a large slow one takes two.
"""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from .chain import Timeline
from .chain.coupled import march_of, period_change, run_last, run_until_steady
from .chain.march import magnetize
from .constants import MU0
from .errors import ConfigurationError
from .extrema import nesting
from .programs import kept
from .scale import Chunk, Job, run_job
from .scale.devices import over_devices


class Signals(eqx.Module):
    """Every signal of the chain over time, SI; `residual` is that of the implicit step, A/m. Of a stack under voltage `field` is
    the voltage and `magnetization` the polarization (see `magjax.terms`); its `flux_density` means nothing.

    `unsettled`: of a steady state, how much the last two periods differ, relative to the peak to peak of H + M; else 0.
    """

    time: Float[Array, " time"]
    command: Float[Array, " time"]
    current: Float[Array, " time"]
    field: Float[Array, " time"]
    magnetization: Float[Array, " time"]
    flux_density: Float[Array, " time"]
    free_displacement: Float[Array, " time"] | None
    displacement: Float[Array, " time"] | None
    reading: Float[Array, " time"]
    relay_field: Float[Array, " time"]
    residual: Float[Array, " time"]
    overflow: Array
    unsettled: Array


MOST_SWEPT = 10_000_000  # steady states of a sweep, or kept samples: 0.6 GB of results
CHUNK, GPU_CHUNK = 512, 40_000  # steady states at a time; fewer leave most of a GPU idle (`python -m tests.studies.gpu`)
MOST_PERIODS = 250  # a drive that has not settled by then is told as it is
TOLERANCE = 1e-8  # of a single steady state; a sweep asks for less


def require_x64():
    """Refuse single precision: the masses and the memory need double."""
    if not jax.config.jax_enable_x64:
        raise ConfigurationError('double precision is off; run jax.config.update("jax_enable_x64", True) before anything else')


def run_chain(actuator, command, dt, periods: int, corners: int, scheme: str | None = None, until=None) -> Signals:
    """The chain as a pure function for `jit`, `vmap` and derivatives. `periods` = 0: not periodic; else run so many
    and return the last. `scheme`: of the coupled step, the coil's own if None. `until` (tolerance, most): instead of
    `periods`, as many as it takes until two differ by less than `tolerance`, see `run_until_steady`."""
    line = Timeline(jnp.asarray(dt, dtype=float), command.shape[0], periods > 0 or until is not None)
    current = driven_current(actuator, command, line)
    return finish_chain(actuator, line, command, current, *march_chain(actuator, line, current, periods, corners, scheme, until))


def driven_current(actuator, command, line):
    """The current in the coil, A (the applied field, A/m, on a field-driven bench): the source and its effects, (time,)."""
    current = actuator.source(command)
    for effect in actuator.effects:
        current = effect.drive(current, line, actuator)
    return current


def march_chain(actuator, line, current, periods: int, corners: int, scheme: str | None = None, until=None):
    """Coil and hysteresis: field H, magnetization M, its spread, relay field, residual (all (time,), A/m), overflow, and how much
    the last two periods differ; see `run_chain`."""
    scheme = scheme or actuator.coil.scheme
    count = current.shape[0]
    applied = actuator.coil.applied_field(current)
    table = actuator.hysteresis.table()
    memory = actuator.hysteresis.memory(table, corners)
    if until is None and periods <= 0:
        rows = magnetize(actuator, applied, current, line.dt, memory, scheme)
        return *rows, jnp.zeros(())
    if until is not None:
        whole = [jnp.append(x, x[:1]) for x in (applied, current)]
        march = march_of(actuator, applied[0], current[0], line.dt, memory, scheme, count)
        *rows, overflow, change = run_until_steady(march, *whole, *until)
        M_unreached = actuator.hysteresis.unreached(*_range(rows[3]))
        H, M, spread, v, residual = (jnp.roll(x, 1) for x in rows)  # a period's end is its first sample
    else:
        whole = [jnp.append(jnp.tile(x, periods), x[:1]) for x in (applied, current)]
        *rows, overflow = magnetize(actuator, *whole, line.dt, memory, scheme, period=count)
        M_unreached = actuator.hysteresis.unreached(*_range(rows[3][-count:]))
        H, M, spread, v, residual = (x[-count - 1 : -1] for x in rows)
        X = (rows[0] + rows[1])[:-1].reshape(periods, count)
        change = period_change(X[-1], X[-2]) if periods > 1 else jnp.asarray(jnp.inf)
    return H, M + M_unreached, spread, v, residual, overflow, change


def march_period(actuator, line, current, times, corners: int, stride):
    """Field H, magnetization M and its spread, A/m, (time,), of the last of `times` periods marched by every `stride`-th sample,
    0 between: see `run_last`. As `march_chain`, but no derivative goes through it."""
    count, h = current.shape[0] // stride, line.dt * stride
    applied = actuator.coil.applied_field(current)
    memory = actuator.hysteresis.memory(actuator.hysteresis.table(), corners)
    march = march_of(actuator, applied[0], current[0], h, memory, actuator.coil.scheme, count)
    (H, M, spread), *ends = run_last(march, applied, current, times, stride)
    return H, M + actuator.hysteresis.unreached(*ends), spread


def _range(field):
    """Highest and lowest of a field over time: read at their place, which asks less of a derivative than a maximum."""
    return field[jnp.argmax(stop_gradient(field))], field[jnp.argmin(stop_gradient(field))]


def finish_chain(actuator, line, command, current, H, M, spread, v, residual, overflow, unsettled=0.0) -> Signals:
    """The blocks after the hysteresis: magnetostriction, mechanics, sensor, with their effects; arguments as from `march_chain`."""
    B = MU0 * (H + M)
    for effect in actuator.effects:
        current = effect.delivered(current, B, line, actuator)
    if actuator.piezo is not None:
        M = actuator.piezo.polarization(M, H)
    signals = {"command": command, "current": current, "field": H, "magnetization": M, "flux_density": B}
    free = displacement = None
    if actuator.strained is not None and actuator.output != "polarization":
        free = actuator.strained(M) if actuator.piezo is not None else actuator.strained(M, spread)
        for effect in actuator.effects:
            free = effect.strain(free, M, H, line, actuator)
        displacement = free
    if actuator.mechanics is not None:
        displacement = actuator.mechanics(free, line)
        for effect in actuator.effects:
            displacement = effect.displacement(displacement, free, signals, line, actuator)
    charge = actuator.piezo.surface_charge(M) if actuator.output == "polarization" else None
    quantity = {"displacement": displacement, "polarization": charge, **signals}[actuator.output]
    if quantity is None:
        raise ConfigurationError(
            f"the bench reads {actuator.output} but has no magnetostriction; add the block or read flux_density"
        )
    reading = actuator.sensor(quantity)
    for effect in actuator.effects:
        reading = effect.reading(reading, {**signals, "displacement": displacement}, line, actuator)
    return Signals(line.time, command, current, H, M, B, free, displacement, reading, v, residual, overflow, unsettled)


_run = kept(run_chain)


def simulate(
    actuator,
    current,
    dt: float,
    *,
    periodic: bool = False,
    settle: int | None = None,
    tolerance: float = TOLERANCE,
    corners=None,
    scheme=None,
    outside: str = "refuse",
) -> Signals:
    """Simulate the actuator.

    `current`: (time,), A (applied field, A/m, or voltage, V, where that drives the bench). `dt`: s. `periodic`: the samples are one period
    (or several whole ones) of a steady drive, repeated until two repetitions differ by less than `tolerance` of the peak to
    peak of H + M (`MOST_PERIODS` at most: `unsettled` of the result tells what is left), or exactly `settle` times before
    the one that is returned. `corners`: room for the memory, found from the drive if None.
    `outside`: "refuse" a drive that leaves the plane, or "saturate" there. Raises `ConfigurationError` for NaN, a drive outside the plane, or a lost corner.

    >>> import jax, numpy as np; jax.config.update("jax_enable_x64", True)
    >>> from magjax.bench import load_bench
    >>> t = np.arange(500) / 500 / 50.0
    >>> signals = simulate(load_bench("aa-050h").actuator(), 0.1 + 0.6 * np.sin(2 * np.pi * 50 * t), t[1], periodic=True)
    >>> signals.displacement.shape
    (500,)
    """
    require_x64()
    drive = np.asarray(current, float)
    if drive.ndim != 1 or drive.size < 2:
        raise ConfigurationError(f"the drive must be one row of samples, not an array of shape {drive.shape}")
    if not np.all(np.isfinite(drive)):
        raise ConfigurationError(f"the drive has a NaN or infinity at sample {int(np.argmin(np.isfinite(drive)))}; mend it first")
    if not dt > 0:
        raise ConfigurationError(f"dt = {dt} s; the time step must be positive")
    if not periodic:
        actuator = dataclasses.replace(actuator, hysteresis=actuator.hysteresis.rested())
    needed = _corners(actuator, drive, periodic) if corners is None else corners
    # dt as an array: a Python number would be part of the program, compiled anew for every frequency
    steps = (jnp.asarray(drive), jnp.asarray(dt, float))
    if periodic and settle is None:
        signals = _run(actuator, *steps, 0, needed, scheme, (jnp.asarray(tolerance, float), MOST_PERIODS))
    else:
        signals = _run(actuator, *steps, (settle + 1) if periodic else 0, needed, scheme)
    if bool(signals.overflow):
        raise ConfigurationError(f"the drive leaves more than {needed} nested corners in the memory; raise corners")
    if outside != "saturate":
        reached = np.asarray(signals.relay_field)
        _refuse_outside(actuator, reached.min(), reached.max())
    return signals


def _corners(actuator, drive, periodic: bool) -> int:
    start = actuator.hysteresis.history.shape[0] // 2
    drive = np.tile(drive, 2) if periodic else drive
    # rounded up, so that similar drives share one compiled program
    return int(4 * np.ceil((nesting(drive) + start) / 4))


def _refuse_outside(actuator, lowest, highest, where=""):
    """Refuse a drive that leads the relays' field beyond the plane, where every relay is saturated and nothing is known."""
    low, high = float(actuator.hysteresis.low), float(actuator.hysteresis.high)
    width = high - low
    if lowest < low - 0.02 * width or highest > high + 0.02 * width:
        terms = actuator.terms
        raise ConfigurationError(
            f"the drive{where} leads the {terms.field} to {lowest:.5g}..{highest:.5g} {terms.unit}, outside the Preisach plane "
            f"{low:.5g}..{high:.5g} {terms.unit}; lower the drive; a fitted plane reaches as far as the recordings, that of a bench file as its limits"
        )


def sweep(
    actuator, frequencies, amplitudes, offsets=(0.0,), *, samples: int = 250, settle: int | None = None, tolerance: float = 3e-4,
    chunk: int | None = None, keep=False, executor=None, checkpoint=None, progress=None,
):  # fmt: skip
    """Steady states for a grid of biased sines, as a labelled xarray Dataset.

    `frequencies` Hz, `amplitudes` and `offsets` in the unit of the drive; `settle` and `tolerance` as in `simulate`
    (where a small loop creeps, three to four times the tolerance may be left). Returns
    peak-to-peak and mean reading, amplitude and phase of its fundamental, loss per cycle (not of a stack under voltage), and `unsettled`, how much the last
    two periods differ; `keep=True` adds the waveforms. The grid is run in chunks of `chunk` trajectories (`CHUNK`, or on a GPU
    `GPU_CHUNK`, if None), so memory does not grow with it, each over the devices that JAX sees; `executor`, `checkpoint` and `progress` as in `magjax.scale.run_job`:
    the numbers are the same to the last bit for any of them. Raises `ConfigurationError` for a frequency that is not above
    zero, a drive outside the plane, or a lost corner.
    """
    import xarray as xr

    require_x64()
    axes = [np.atleast_1d(np.asarray(x, float)) for x in (frequencies, amplitudes, offsets)]
    for name, values in zip(("frequencies", "amplitudes", "offsets"), axes, strict=True):
        wrong = values[~np.isfinite(values) | ((values <= 0) & (name == "frequencies"))]
        if wrong.size or not values.size:
            found = f"{wrong[0]:g} among them" if wrong.size else "none given"
            raise ConfigurationError(
                f"{name}: {found}; give {'numbers above zero, Hz' if name == 'frequencies' else 'finite numbers'}"
            )
    shape = tuple(len(x) for x in axes)
    values, most = math.prod(shape) * (samples if keep else 1), MOST_SWEPT
    if values > most:
        what = f"{values:,} kept samples" if keep else f"{values:,} steady states"
        raise ConfigurationError(f"{what} in one sweep, at most {most:,} fit; sweep parts of the grid, each to its own file")
    grid = [x.ravel() for x in np.meshgrid(*axes, indexing="ij")]
    start = actuator.hysteresis.history.shape[0] // 2
    corners = int(4 * np.ceil((4 + start) / 4))
    total = len(grid[0])
    if chunk is None:
        chunk = CHUNK if jax.default_backend() == "cpu" else GPU_CHUNK
    chunk = min(chunk, total)
    chunks = []
    for begin in range(0, total, chunk):
        index = np.arange(begin, min(begin + chunk, total))
        chunks.append(Chunk(f"{begin}-{begin + len(index) - 1}", [x[index] for x in grid]))
    inputs = {
        "actuator": actuator,
        "chunk": chunk,
        "samples": samples,
        "settle": settle,
        "tolerance": tolerance,
        "corners": corners,
        "keep": keep,
    }
    parts = run_job(Job("sweep", _sweep_part, inputs, tuple(chunks)), executor, checkpoint=checkpoint, progress=progress).results
    columns = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
    dims = ("frequency", "amplitude", "offset")
    data = {}
    for name, values in columns.items():
        extra = ("phase",) if values.ndim == 2 else ()
        data[name] = ((*dims, *extra), values.reshape(shape + values.shape[1:]))
    coords = dict(zip(dims, axes, strict=True))
    if keep:
        coords["phase"] = np.arange(samples) / samples
    result = xr.Dataset(
        data, coords=coords, attrs={"output": actuator.output, "drive": actuator.coil.drive, "tolerance": tolerance}
    )
    unit = UNITS[actuator.output]
    for name in ("peak_to_peak", "mean", "fundamental"):
        result[name].attrs["units"] = unit
    result["lag"].attrs["units"] = "rad"
    if "loss" in result:
        result["loss"].attrs["units"] = "J/m^3"
    result["frequency"].attrs["units"] = "Hz"
    result["unsettled"].attrs["units"] = "1"
    return result


def _sweep_part(inputs, points, rng):
    """One chunk of a sweep, filled up by its last point to the common size so that all run the same program."""
    actuator, count = inputs["actuator"], len(points[0])
    # slow ones beside slow ones: a batch goes on until its last one has settled
    order = np.argsort(points[0] / np.maximum(np.abs(points[1]), 1e-12), kind="stable")
    full = [np.append(x[order], np.full(inputs["chunk"] - count, x[order[-1]])) for x in points]
    until = None if inputs["settle"] is not None else (inputs["tolerance"], MOST_PERIODS)
    options = {k: inputs[k] for k in ("samples", "corners", "keep")}
    found = over_devices(_sweep_chunk, actuator, full, periods=(inputs["settle"] or 0) + 1, until=until, **options)
    back = np.argsort(order, kind="stable")
    found = {k: np.asarray(v)[:count][back] for k, v in found.items()}
    for k, (low, high, overflow) in enumerate(zip(*(found.pop(n) for n in ("lowest", "highest", "overflow")), strict=True)):
        where = f" at {points[0][k]:g} Hz, amplitude {points[1][k]:g}, offset {points[2][k]:g}"
        _refuse_outside(actuator, low, high, where)
        if overflow:
            raise ConfigurationError(f"the drive{where} leaves more than {inputs['corners']} nested corners in the memory")
    return found


BATCH = 32  # trajectories side by side on a CPU: more are no faster, and wait for each other to settle


@eqx.filter_jit
def _sweep_chunk(actuator, frequency, amplitude, offset, samples, periods, until, corners, keep):
    phase = 2 * jnp.pi * jnp.arange(samples) / samples

    def one(point):
        f, A, b = point
        signals = run_chain(actuator, b + A * jnp.sin(phase), 1 / (f * samples), periods, corners, until=until)
        y = signals.reading
        tone = 2 * jnp.mean(y * jnp.exp(-1j * phase)) * 1j
        applied = actuator.coil.applied_field(signals.current)
        B = signals.flux_density
        results = {
            "peak_to_peak": jnp.max(y) - jnp.min(y),
            "mean": jnp.mean(y),
            "fundamental": jnp.abs(tone),
            "lag": -jnp.angle(tone),
            "loss": 0.5 * jnp.sum((applied + jnp.roll(applied, -1)) * (jnp.roll(B, -1) - B)),
            "unsettled": signals.unsettled,
            "lowest": jnp.min(signals.relay_field),
            "highest": jnp.max(signals.relay_field),
            "overflow": signals.overflow,
        }
        if actuator.coil.drive == "voltage":  # its energy takes the charge, which is not in the model
            del results["loss"]
        return {**results, "reading": y, actuator.terms.field: signals.field} if keep else results

    count = len(frequency)
    width = min(count, BATCH) if jax.default_backend() == "cpu" else count
    rows = jnp.minimum(jnp.arange(-(-count // width) * width), count - 1).reshape(-1, width)
    found = jax.lax.map(jax.vmap(one), [x[rows] for x in (frequency, amplitude, offset)])
    return {k: v.reshape(-1, *v.shape[2:])[:count] for k, v in found.items()}


UNITS = {
    "current": "A", "field": "A/m", "magnetization": "A/m", "flux_density": "T", "free_displacement": "m", "displacement": "m",
    "relay_field": "A/m", "voltage": "V", "polarization": "C/m^2",
}  # fmt: skip


def signals_dataset(signals: Signals, actuator, bench: str = ""):
    """Every signal as a labelled xarray Dataset with units; `actuator`: the one simulated, which knows what drives it and what is read."""
    import xarray as xr

    time = np.asarray(signals.time)
    drive, terms = UNITS[actuator.coil.drive], actuator.terms
    units = {"command": drive, **UNITS, "current": drive, "reading": UNITS[actuator.output]}
    names = {}
    if actuator.coil.drive == "voltage":  # applied and seen by the relays are one
        names = {"field": "voltage", "magnetization": "polarization"}
        units = {n: u for n, u in units.items() if n not in ("current", "flux_density", "relay_field")}
        units |= {"field": terms.unit, "magnetization": terms.state_unit}
    values = {n: np.asarray(getattr(signals, n)) for n in units if getattr(signals, n, None) is not None}
    data = {names.get(n, n): ("time", v, {"units": units[n]}) for n, v in values.items()}
    return xr.Dataset(data, coords={"time": ("time", time, {"units": "s"})}, attrs={"bench": bench, "output": actuator.output})
