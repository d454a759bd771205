"""The terminal while recording: counts, rate, losses, disk, and the loop as it comes in."""

import time


class Live:
    """Progress by rich on stderr; silent when asked or where stderr is no terminal (one line every two seconds then)."""

    def __init__(self, quiet: bool):
        self.quiet, self.live, self.before, self.told = quiet, None, None, 0.0
        self.title = ""

    def __enter__(self):
        if self.quiet:
            return self
        from rich.console import Console

        self.console = Console(stderr=True)
        if self.console.is_terminal:
            from rich.live import Live as RichLive

            self.live = RichLive("waiting for the device", console=self.console, refresh_per_second=5, transient=True)
            self.live.start()
        return self

    def __exit__(self, *_):
        if self.live is not None:
            self.live.stop()

    def __call__(self, state: dict) -> None:
        """One report of the recorder."""
        if self.quiet:
            return
        row = self._row(state)
        if self.live is not None:
            self.live.update(row + "\n" + draw_loop(state["loop"]) if state.get("loop") else row)
        elif time.monotonic() - self.told > 2:
            self.told = time.monotonic()
            self.console.print(row, highlight=False, soft_wrap=True)

    def tell(self, text: str) -> None:
        """What is being done between recordings."""
        if self.live is not None:
            from rich.spinner import Spinner

            self.live.update(Spinner("dots", text=text))

    def _row(self, state):
        rate = ""
        if self.before and state["host_time"] > self.before["host_time"]:
            rate = f" {(state['received'] - self.before['received']) / (state['host_time'] - self.before['host_time']):.4g}/s,"
        self.before = state
        free = state["disk_free"] / 1e9
        return (
            f"{self.title}{state['acknowledged']} samples safe,{rate} {state['lost']} lost, {state['damaged_frames']} damaged frames, "
            f"{state['bytes'] / 1e6:.2f} MB written, {free:.0f} GB free"
        )


def draw_loop(loop, width: int = 56, height: int = 16) -> str:
    """The first two channels against each other, in characters: drive to the right, reading upward."""
    x, y = loop[0], loop[1] if len(loop) > 1 else range(len(loop[0]))
    low, high, bottom, top = min(x), max(x), min(y), max(y)
    grid = [[" "] * width for _ in range(height)]
    for a, b in zip(x, y, strict=True):
        column = int((a - low) / ((high - low) or 1) * (width - 1))
        row = int((b - bottom) / ((top - bottom) or 1) * (height - 1))
        grid[height - 1 - row][column] = "o"
    edge = "+" + "-" * width + "+"
    rows = [edge, *("|" + "".join(r) + "|" for r in grid), edge]
    return "\n".join([*rows, f"current {low:.3g} .. {high:.3g} A, reading {bottom:.3g} .. {top:.3g}"])
