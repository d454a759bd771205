"""A sign of life on the terminal: a spinner with what is being done and for how long, from the first half second of a command.

It stands on stderr, only where that is a terminal, and goes for good when the command writes its result.
"""

import sys

_shown = []  # the spinner of the running command: there is one terminal


def tell(text: str) -> None:
    """What the running command does now; nothing where no spinner stands."""
    for waiting in _shown:
        waiting.tell(text)


class _Stops:
    """A stream that ends the spinner before the first text passes through it."""

    def __init__(self, stream, stop):
        self._stream, self._stop = stream, stop

    def write(self, text):
        """Write, the spinner gone."""
        self._stop()
        return self._stream.write(text)

    def __getattr__(self, name):
        return getattr(self._stream, name)


class Waiting:
    """The spinner of one command as a context; `tell` changes its words. `active` False: nothing is ever shown."""

    def __init__(self, text: str, active: bool = True):
        self._text, self._active, self._shown = text, active and sys.stderr.isatty(), None

    def __enter__(self):
        if self._active:
            from rich.console import Console
            from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

            columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
            console = Console(file=sys.stderr)
            self._shown = Progress(*columns, console=console, transient=True, redirect_stdout=False, redirect_stderr=False)
            self._task = self._shown.add_task(self._text, total=None)
            self._shown.start()
            self._streams = sys.stdout, sys.stderr
            # kept: print() holds its stream by a borrowed reference while it writes
            self._wrapped = sys.stdout, sys.stderr = tuple(_Stops(s, self.stop) for s in self._streams)
            _shown.append(self)
        return self

    def __exit__(self, *_):
        self.stop()

    def tell(self, text: str) -> None:
        """What is being done now."""
        if self._shown is not None:
            self._shown.update(self._task, description=text)

    def stop(self) -> None:
        """Take the spinner away; the streams are themselves again."""
        if self._shown is not None:
            shown, self._shown = self._shown, None
            _shown.remove(self)
            sys.stdout, sys.stderr = self._streams
            shown.stop()
