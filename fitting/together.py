"""Fits side by side in threads: while the compiled work of one runs, another's Python goes on.

What is run together, and in which order it is told, does not depend on the machine: results do not either.
"""

import concurrent.futures
import contextlib
import gc
import threading

import jax

from magjax.effects.base import AbstractEffect
from magjax.programs import forget, trim

SIDE_BY_SIDE = 2


class Ended(Exception):
    """Raised inside a call that nobody waits for any more."""


def together(calls, progress=None, needless=None) -> list:
    """Results of `calls`, each a function of one progress function, in their order, two at a time.

    `progress`: called as progress(text, step, chi2 per datum), with all words of one call before those of the next: these
    are kept until it is their turn. `needless(k, results)`: whether the results so far, {number: result}, make call k of no
    use; it is ended at its next word and gives None, ended or not.
    The first error, or Ctrl-C, ends the others and is raised.
    """
    calls = list(calls)
    if len(calls) < 2:
        return [call(progress or (lambda *words: None)) for call in calls]
    ended, results = [threading.Event() for _ in calls], {}
    turns = _Turns(len(calls), progress or (lambda *words: None))

    def run(k):
        def say(*words):
            if ended[k].is_set():
                raise Ended
            turns.say(k, words)

        with contextlib.suppress(Ended):
            results[k] = calls[k](say)
        turns.over(k)

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


class _Turns:
    """Words of calls that run side by side, passed on call by call: whose turn it is speaks at once, others wait."""

    def __init__(self, count, progress):
        self.progress, self.lock = progress, threading.Lock()
        self.waiting, self.done, self.turn = [[] for _ in range(count)], set(), 0

    def say(self, k, words):
        with self.lock:
            self.waiting[k].append(words)
            self._pass_on()

    def over(self, k):
        with self.lock:
            self.done.add(k)
            self._pass_on()

    def _pass_on(self):
        while self.turn < len(self.waiting):
            words, self.waiting[self.turn] = self.waiting[self.turn], []
            for word in words:
                self.progress(*word)
            if self.turn not in self.done:
                return
            self.turn += 1


def let_go(*actuators) -> None:
    """Give back the memory of compiled programs that are not needed again, some hundred megabytes each: of all but those that know
    no other effects than one of the `actuators` has."""
    sets = [{type(e) for e in a.effects} for a in actuators]
    forget(lambda kinds: any({k for k in kinds if issubclass(k, AbstractEffect)} <= own for own in sets))
    jax.clear_caches()
    gc.collect()
    trim()
