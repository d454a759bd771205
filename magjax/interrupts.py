"""Ctrl-C that must not be lost: one that lands inside an import can be swallowed there, and the command would go on."""

import contextlib
import signal
import threading

_seen = threading.Event()


def _remember(number, frame):
    _seen.set()
    raise KeyboardInterrupt


@contextlib.contextmanager
def watched():
    """While it lasts, Ctrl-C raises `KeyboardInterrupt` as ever and is remembered, in case somebody swallows that."""
    _seen.clear()
    main = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGINT)
    ours = main and before is signal.default_int_handler
    if ours:
        signal.signal(signal.SIGINT, _remember)
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGINT, before)


def seen() -> bool:
    """Whether Ctrl-C came."""
    return _seen.is_set()


def raise_if_seen() -> None:
    """Raise `KeyboardInterrupt` where one came and was lost: call it before what cannot be left half done."""
    if _seen.is_set():
        raise KeyboardInterrupt
