"""Which samples came: sequence numbers and clocks unwrapped, gaps and repeats told apart, every loss counted."""

HALF = 1 << 31
FULL = 1 << 32


class Tracker:
    """Accounts one run. `whole`: samples of every frame, 0 where `seq` counts samples itself (text lines).

    `received`, `gaps` [(first sample, samples)], `repeats`; `clock_jumps` counts frames whose time does not fit their number.
    """

    def __init__(self, rate: float, first_seq: int, whole: int, clock_bits: int = 64):
        self.rate, self.whole, self.clock = rate, whole, 1 << clock_bits
        self.first_seq = first_seq
        self.next = 0  # unwrapped number that comes next, from zero
        self.received = self.repeats = self.clock_jumps = 0
        self.gaps = []
        self.origin = None  # device time of sample 0, us

    def accept(self, seq: int, time_us: int, count: int):
        """(sample number, unwrapped device time in us) of a frame's first sample; None for a repeat; "reset" where the device began anew."""
        ahead = (seq - self.first_seq - self.next + HALF) % FULL - HALF
        number = self.next + ahead
        index = number * (self.whole or 1)
        if ahead < 0:
            if self.whole == 0 and not self._near(index, time_us):
                return "reset"
            self.repeats += 1
            return None
        if ahead > 0:
            begin = self.next * (self.whole or 1)
            self.gaps.append((begin, index - begin))
        time = self._unwrap(index, time_us)
        self.received += count
        self.next = number + (1 if self.whole else count)
        return index, time

    def _near(self, index, time_us) -> bool:
        expected = self.origin + 1e6 * index / self.rate if self.origin is not None and self.rate else None
        return expected is None or abs((time_us - expected + self.clock / 2) % self.clock - self.clock / 2) < 2e5

    def _unwrap(self, index, time_us):
        ahead = 1e6 * index / self.rate if self.rate else 0.0
        if self.origin is None:
            self.origin = time_us - ahead
            return int(time_us)
        expected = int(self.origin + ahead)
        time = expected + (time_us - expected + self.clock // 2) % self.clock - self.clock // 2
        if self.rate and abs(time - expected) > max(1000.0, 0.01 * ahead):
            self.clock_jumps += 1
        return time

    @property
    def known_lost(self) -> int:
        """Samples in the gaps so far; the tail is known from FINAL only."""
        return sum(n for _, n in self.gaps)
