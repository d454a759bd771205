"""The time grid that the blocks after the coil share, with exact linear filtering on it.

Periodic signals are filtered in the frequency domain: the steady state for nothing. Others are held at their first
value before the start and carried smoothly back to it in a quiet tail, long enough for every lag to die out.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class Timeline(eqx.Module):
    """`dt`: s. `periodic`: whether the samples are one steady period. `start`: time of the first sample, s."""

    dt: Float[Array, ""]
    count: int = eqx.field(static=True)
    periodic: bool = eqx.field(static=True)
    start: float | Float[Array, ""] = 0.0

    @property
    def time(self):
        """Sample times, s, (time,)."""
        return self.start + self.dt * jnp.arange(self.count)

    @property
    def _length(self):
        return self.count if self.periodic else 4 * self.count

    @property
    def angular_frequency(self):
        """w of the bins of the real transform, rad/s."""
        return 2 * jnp.pi * jnp.arange(self._length // 2 + 1) / (self._length * self.dt)

    def _extended(self, signal):
        if self.periodic:
            return signal
        tail = self._length - self.count
        fade = jnp.clip(jnp.arange(1, tail + 1) / (self.count // 2 + 1), 0.0, 1.0)
        fade = fade * fade * (3 - 2 * fade)
        return jnp.concatenate([signal, signal[-1] + (signal[0] - signal[-1]) * fade])

    def filter(self, signal, response):
        """Apply a linear system with frequency response `response(s)`, s = i w, to a signal (time,)."""
        spectrum = jnp.fft.rfft(self._extended(signal))
        gain = response(1j * self.angular_frequency)
        if self._length % 2 == 0:
            gain = gain.at[-1].set(gain[-1].real)
        return jnp.fft.irfft(spectrum * gain, self._length)[: self.count]

    def derivative(self, signal):
        """d/dt: spectral where periodic, central differences elsewhere."""
        if not self.periodic:
            return jnp.gradient(signal, 1.0) / self.dt
        return self.filter(signal, lambda s: s * (jnp.abs(s) < jnp.abs(s[-1]) - 1e-9))
