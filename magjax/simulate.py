"""simulate(actuator, current, dt): the whole chain for one drive; sweep: a grid of frequencies, amplitudes and offsets.

Current (A) or applied field (A/m) in, every signal of the chain out, SI. Periodic drives end in their steady state.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .chain import Timeline
from .chain.coupled import magnetize
from .constants import MU0
from .errors import ConfigurationError
from .extrema import nesting
from .scale import Chunk, Job, run_job
from .scale.devices import over_devices


class Signals(eqx.Module):
    """Every signal of the chain over time, SI; `residual` is that of the implicit step, A/m."""

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


def require_x64():
    """Refuse single precision: the masses and the memory need double."""
    if not jax.config.jax_enable_x64:
        raise ConfigurationError('double precision is off; run jax.config.update("jax_enable_x64", True) before anything else')


def run_chain(actuator, command, dt, periods: int, corners: int, scheme: str | None = None) -> Signals:
    """The chain as a pure function for `jit`, `vmap` and derivatives. `periods` = 0: not periodic; else run so many
    and return the last. `scheme`: of the coupled step, the coil's own if None."""
    line = Timeline(jnp.asarray(dt, dtype=float), command.shape[0], periods > 0)
    current = driven_current(actuator, command, line)
    return finish_chain(actuator, line, command, current, *march_chain(actuator, line, current, periods, corners, scheme))


def driven_current(actuator, command, line):
    """The current in the coil, A (the applied field, A/m, on a field-driven bench): the source and its effects, (time,)."""
    current = actuator.source(command)
    for effect in actuator.effects:
        current = effect.drive(current, line, actuator)
    return current


def march_chain(actuator, line, current, periods: int, corners: int, scheme: str | None = None):
    """Coil and hysteresis: field H, magnetization M, relay field, residual (all (time,), A/m) and overflow; see `run_chain`."""
    scheme = scheme or actuator.coil.scheme
    count = current.shape[0]
    applied = actuator.coil.applied_field(current)
    table = actuator.hysteresis.table()
    memory = actuator.hysteresis.memory(table, corners)
    if periods > 0:
        whole = [jnp.append(jnp.tile(x, periods), x[:1]) for x in (applied, current)]
        parts = magnetize(actuator, *whole, line.dt, memory, scheme, period=count)
        M_unreached = actuator.hysteresis.unreached(jnp.max(parts[2][-count:]), jnp.min(parts[2][-count:]))
        H, M, v, residual = (x[-count - 1 : -1] for x in parts[:4])
        M = M + M_unreached
    else:
        parts = magnetize(actuator, applied, current, line.dt, memory, scheme)
        H, M, v, residual = parts[:4]
    return H, M, v, residual, parts[4]


def finish_chain(actuator, line, command, current, H, M, v, residual, overflow) -> Signals:
    """The blocks after the hysteresis: magnetostriction, mechanics, sensor, with their effects."""
    B = MU0 * (H + M)
    signals = {"command": command, "current": current, "field": H, "magnetization": M, "flux_density": B}
    free = displacement = None
    if actuator.magnetostriction is not None:
        free = actuator.magnetostriction(M)
        for effect in actuator.effects:
            free = effect.strain(free, M, H, line, actuator)
        displacement = free
    if actuator.mechanics is not None:
        displacement = actuator.mechanics(free, line)
        for effect in actuator.effects:
            displacement = effect.displacement(displacement, free, signals, line, actuator)
    quantity = {"displacement": displacement, **signals}[actuator.output]
    if quantity is None:
        raise ConfigurationError(
            f"the bench reads {actuator.output} but has no magnetostriction; add the block or read flux_density"
        )
    reading = actuator.sensor(quantity)
    for effect in actuator.effects:
        reading = effect.reading(reading, {**signals, "displacement": displacement}, line, actuator)
    return Signals(line.time, command, current, H, M, B, free, displacement, reading, v, residual, overflow)


_run = eqx.filter_jit(run_chain)


def simulate(actuator, current, dt: float, *, periodic: bool = False, settle: int = 3, corners=None, scheme=None) -> Signals:
    """Simulate the actuator.

    `current`: (time,), A (applied field, A/m, on a field-driven bench). `dt`: s. `periodic`: the samples are one period
    (or several whole ones) of a steady drive; `settle` further repetitions run first. `corners`: room for the memory,
    found from the drive if None. Raises `ConfigurationError` for NaN, a drive outside the plane, or a lost corner.

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
    signals = _run(actuator, jnp.asarray(drive), jnp.asarray(dt, float), (settle + 1) if periodic else 0, needed, scheme)
    if bool(signals.overflow):
        raise ConfigurationError(f"the drive leaves more than {needed} nested corners in the memory; raise corners")
    _refuse_outside(actuator, signals)
    return signals


def _corners(actuator, drive, periodic: bool) -> int:
    start = actuator.hysteresis.history.shape[0] // 2
    drive = np.tile(drive, 2) if periodic else drive
    # rounded up, so that similar drives share one compiled program
    return int(4 * np.ceil((nesting(drive) + start) / 4))


def _refuse_outside(actuator, signals):
    low, high = float(actuator.hysteresis.low), float(actuator.hysteresis.high)
    width = high - low
    reached = np.asarray(signals.relay_field)
    if reached.min() < low - 0.02 * width or reached.max() > high + 0.02 * width:
        raise ConfigurationError(
            f"the drive leads the field to {reached.min():.5g}..{reached.max():.5g} A/m, outside the Preisach plane "
            f"{low:.5g}..{high:.5g} A/m; lower the drive or widen the plane (limits in the bench file)"
        )


def sweep(
    actuator, frequencies, amplitudes, offsets=(0.0,), *, samples: int = 250, settle: int = 2, chunk: int = 512, keep=False,
    executor=None, checkpoint=None, progress=None,
):  # fmt: skip
    """Steady states for a grid of biased sines, as a labelled xarray Dataset.

    `frequencies` Hz, `amplitudes` and `offsets` in the unit of the drive. Returns peak-to-peak and mean reading,
    amplitude and phase of its fundamental, and loss per cycle; `keep=True` adds the waveforms. The grid is run in
    chunks of `chunk` trajectories, so memory does not grow with it, each over the devices that JAX sees; `executor`,
    `checkpoint` and `progress` as in `magjax.scale.run_job`: the numbers are the same to the last bit for any of them.
    """
    import xarray as xr

    require_x64()
    axes = [np.atleast_1d(np.asarray(x, float)) for x in (frequencies, amplitudes, offsets)]
    grid = [x.ravel() for x in np.meshgrid(*axes, indexing="ij")]
    shape = tuple(len(x) for x in axes)
    start = actuator.hysteresis.history.shape[0] // 2
    corners = int(4 * np.ceil((4 + start) / 4))
    total = len(grid[0])
    chunk = min(chunk, total)
    chunks = []
    for begin in range(0, total, chunk):
        index = np.arange(begin, min(begin + chunk, total))
        chunks.append(Chunk(f"{begin}-{begin + len(index) - 1}", [x[index] for x in grid]))
    inputs = {"actuator": actuator, "chunk": chunk, "samples": samples, "periods": settle + 1, "corners": corners, "keep": keep}
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
    result = xr.Dataset(data, coords=coords, attrs={"output": actuator.output, "drive": actuator.coil.drive})
    unit = UNITS[actuator.output]
    for name in ("peak_to_peak", "mean", "fundamental"):
        result[name].attrs["units"] = unit
    result["lag"].attrs["units"] = "rad"
    result["loss"].attrs["units"] = "J/m^3"
    result["frequency"].attrs["units"] = "Hz"
    return result


def _sweep_part(inputs, points, rng):
    """One chunk of a sweep, filled up by its last point to the common size so that all run the same program."""
    count = len(points[0])
    full = [np.append(x, np.full(inputs["chunk"] - count, x[-1])) for x in points]
    options = {k: inputs[k] for k in ("samples", "periods", "corners", "keep")}
    found = over_devices(_sweep_chunk, inputs["actuator"], full, **options)
    return {k: np.asarray(v)[:count] for k, v in found.items()}


@eqx.filter_jit
def _sweep_chunk(actuator, frequency, amplitude, offset, samples, periods, corners, keep):
    phase = 2 * jnp.pi * jnp.arange(samples) / samples

    def one(f, A, b):
        signals = run_chain(actuator, b + A * jnp.sin(phase), 1 / (f * samples), periods, corners)
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
        }
        return {**results, "reading": y, "field": signals.field} if keep else results

    return jax.vmap(one)(frequency, amplitude, offset)


UNITS = {
    "current": "A", "field": "A/m", "magnetization": "A/m", "flux_density": "T", "free_displacement": "m", "displacement": "m",
    "relay_field": "A/m",
}  # fmt: skip


def signals_dataset(signals: Signals, actuator, bench: str = ""):
    """Every signal as a labelled xarray Dataset with units; `actuator`: the one simulated, which knows what drives it and what is read."""
    import xarray as xr

    time = np.asarray(signals.time)
    drive = UNITS[actuator.coil.drive]
    units = {"command": drive, **UNITS, "current": drive, "reading": UNITS[actuator.output]}
    values = {n: np.asarray(getattr(signals, n)) for n in units if getattr(signals, n) is not None}
    data = {n: ("time", v, {"units": units[n]}) for n, v in values.items()}
    return xr.Dataset(data, coords={"time": ("time", time, {"units": "s"})}, attrs={"bench": bench, "output": actuator.output})
