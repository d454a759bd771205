"""Faults of a serial link and its device, to be injected by the emulator: one word each, value behind "=".

drop=P, flip=P: probability that a byte vanishes, that a byte loses a bit.  merge=P, duplicate=P: probability that a frame loses
its zero, that it is sent twice.  zeros=N: N zero bytes once.  reset=FRAME: the device boots anew.  stall=S: silence of S seconds, once.
unplug=S: the port vanishes for S seconds and comes back under another name.  wrap: counter and clock start close below 2^32.
drift=PPM: the device's clock runs fast.  shift=S: the displacement is read late.  `at=FRAME` says when the single ones happen.
"""

import dataclasses

import numpy as np

from ..errors import ConfigurationError

PROBABILITIES = ("drop", "flip", "merge", "duplicate")


@dataclasses.dataclass
class Faults:
    """Probabilities and single events; see the module."""

    drop: float = 0.0
    flip: float = 0.0
    merge: float = 0.0
    duplicate: float = 0.0
    zeros: float = 0.0
    reset: float = 0.0
    stall: float = 0.0
    unplug: float = 0.0
    wrap: float = 0.0
    drift: float = 0.0
    shift: float = 0.0
    at: float = 100.0
    seed: int = 0

    def __post_init__(self):
        self.random = np.random.default_rng(self.seed)
        self.damages = any((self.drop, self.flip, self.merge, self.duplicate))

    def mangle(self, frame: bytes) -> bytes:
        """One frame as it arrives."""
        if not self.damages:
            return frame
        random = self.random
        if self.duplicate and random.random() < self.duplicate:
            frame = frame + frame
        if self.merge and random.random() < self.merge:
            frame = frame[:-1]
        if self.flip or self.drop:
            content = np.frombuffer(frame, np.uint8).copy()
            hit = random.random(len(content)) < self.flip
            content[hit] ^= (1 << random.integers(0, 8, hit.sum())).astype(np.uint8)
            frame = content[random.random(len(content)) >= self.drop].tobytes()
        return frame


def read_faults(words, seed: int = 0) -> Faults:
    """Faults from words such as "drop=1e-4" or "wrap"; raises `ConfigurationError` for one that is unknown."""
    known = [f.name for f in dataclasses.fields(Faults) if f.name != "seed"]
    values = {}
    for word in words:
        name, _, value = word.partition("=")
        try:
            values[name] = float(value) if value else 1.0
        except ValueError:
            values[name] = None
        if name not in known or values[name] is None or not 0 <= values[name] < 1e12:
            raise ConfigurationError(f'"{word}" is no fault; write one of {", ".join(known)} with =VALUE')
        if name in PROBABILITIES and values[name] > 1:
            raise ConfigurationError(f'"{word}": {name} is a probability; give 0 to 1')
    return Faults(**values, seed=seed)
