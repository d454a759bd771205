"""Fits side by side in threads: while the compiled work of one runs, another's Python goes on.

What is run together, and in which order it is told, does not depend on the machine: results do not either.
"""

import concurrent.futures
import contextlib
import ctypes
import gc
import sys
import threading

import jax

SIDE_BY_SIDE = 2


class Ended(Exception):
    """Raised inside a call that nobody waits for any more."""


def together(calls, progress=None, needless=None) -> list:
    """Results of `calls`, each a function of one progress function, in their order, two at a time.

    `progress`: called as progress(text, step, chi2 per datum) by one of them at a time. `needless(k, results)`: whether the
    results so far, {number: result}, make call k of no use; it is ended at its next word and gives None, ended or not.
    The first error, or Ctrl-C, ends the others and is raised.
    """
    calls = list(calls)
    if len(calls) < 2:
        return [call(progress or (lambda *words: None)) for call in calls]
    ended, speaking, results = [threading.Event() for _ in calls], threading.Lock(), {}

    def run(k):
        def say(*words):
            if ended[k].is_set():
                raise Ended
            if progress is not None:
                with speaking:
                    progress(*words)

        with contextlib.suppress(Ended):
            results[k] = calls[k](say)

    with concurrent.futures.ThreadPoolExecutor(SIDE_BY_SIDE) as pool:
        waited = [pool.submit(run, k) for k in range(len(calls))]
        try:
            for done in concurrent.futures.as_completed(waited):
                done.result()
                for k in range(len(calls)) if needless else ():
                    if needless(k, dict(results)):
                        ended[k].set()
        except BaseException:
            for event, future in zip(ended, waited, strict=True):
                event.set()
                future.cancel()
            raise
    return [None if ended[k].is_set() else results[k] for k in range(len(calls))]


def let_go() -> None:
    """Give back the memory of compiled programs that are not needed again: some hundred megabytes each."""
    jax.clear_caches()
    gc.collect()
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc keeps what threads have freed
        if trim is not None:
            trim(0)
