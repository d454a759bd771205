"""Where chunks run: this process, a pool of processes, any concurrent.futures executor, dask.distributed.

An engine's `run` yields (chunk id, encoded result) as chunks finish, in any order; `lost` counts workers that died.
"""

import concurrent.futures
import contextlib
import hashlib
import multiprocessing
import os
import signal
import uuid
from collections import Counter, deque
from concurrent.futures.process import BrokenProcessPool

from ..errors import ConfigurationError
from .worker import begin, one_thread, pack, perform_opened, perform_packed

TRIES = 3  # workers that one chunk may cost
DASK_TRIES = 2  # times that a chunk is given to dask, which spends several workers on each
PATIENCE = 10.0  # s, for a dask scheduler to answer
KINDS = '"processes:N", "dask:ADDRESS", a dask.distributed Client or a concurrent.futures Executor'


def engine(executor):
    """The engine that an `executor=` argument names. Raises `ConfigurationError` for what is none."""
    if executor is None:
        return InProcess()
    if isinstance(executor, str):
        kind, _, rest = executor.partition(":")
        if kind == "processes" and rest.isdecimal() and int(rest) > 0:
            return Processes(int(rest))
        if kind == "dask" and rest:
            return Dask(rest)
        raise ConfigurationError(f'executor "{executor}" is unknown; give None, {KINDS}')
    if isinstance(executor, concurrent.futures.Executor):
        return Foreign(executor)
    if hasattr(executor, "scheduler_info") and hasattr(executor, "submit"):
        return Dask(executor)
    raise ConfigurationError(f"executor of type {type(executor).__name__} is unknown; give None, {KINDS}")


def _given_up(name, chunk, words):
    return ConfigurationError(
        f"{name}: chunk {chunk} {words}; finished ones are in the checkpoint, if one was given: give each worker more memory "
        "(fewer --workers), then resume"
    )


class InProcess:
    """One chunk after the other, here."""

    lost = 0

    def run(self, name, work, inputs, tasks):
        """See the module."""
        from .job import perform

        for chunk, item, entropy in tasks:
            with one_thread():
                result = perform(work, inputs, item, entropy)
            yield chunk, result


class _Worker:
    """A spawned process (JAX does not survive a fork) behind a pool of one, with the inputs of a job."""

    def __init__(self, key: str, blob: bytes):
        self.key = key
        self.pool = concurrent.futures.ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
        self.started = self.pool.submit(begin, key, blob)

    def give(self, work, task):
        """Begin a chunk; raises `BrokenProcessPool` where the process died while it waited."""
        return self.pool.submit(perform_opened, work, self.key, *task[1:])

    def result(self, future):
        """The encoded result; what went wrong when the process began comes first."""
        self.started.result()
        return future.result()

    def leave(self, busy: bool):
        """Let the process go, at once where it is busy for nobody."""
        self.pool.shutdown(wait=not busy, cancel_futures=True)
        if busy and self.started.done() and self.started.exception() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.started.result(), signal.SIGTERM)


class Processes:
    """`count` fresh processes, one pool of one process each.

    A pool breaks as a whole when a process of it dies; with one process a pool the death of a worker costs the chunk that it
    was at and no other, and the chunk is known. The chunk is given to a fresh process, three times at most.
    """

    def __init__(self, count: int):
        self.count, self.lost = count, 0

    def run(self, name, work, inputs, tasks):
        """See the module."""
        blob = pack(inputs)
        key = hashlib.sha256(blob).hexdigest()
        waiting, cost = deque(tasks), Counter()
        idle, running = [], {}
        try:
            while waiting or running:
                while waiting and len(running) < self.count:
                    worker = idle.pop() if idle else _Worker(key, blob)
                    try:
                        running[worker.give(work, waiting[0])] = (worker, waiting[0])
                    except BrokenProcessPool:  # died between two chunks: costs none
                        self._bury(name, worker, cost, None)
                    else:
                        waiting.popleft()
                done, _ = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
                for future in done:
                    worker, task = running.pop(future)
                    try:
                        result = worker.result(future)
                    except BrokenProcessPool:
                        self._bury(name, worker, cost, task[0])
                        waiting.appendleft(task)
                    else:
                        idle.append(worker)
                        yield task[0], result
        finally:
            for worker in idle:
                worker.leave(busy=False)
            for worker, _ in running.values():
                worker.leave(busy=True)

    def _bury(self, name, worker, cost, chunk):
        """Count a dead worker; give up where a chunk has cost too many, or where all die between chunks."""
        worker.leave(busy=False)
        self.lost += 1
        cost[chunk] += 1
        if chunk is not None and cost[chunk] == TRIES:
            words = f'ended its worker {TRIES} times (killed, out of memory, or the script lacks its `if __name__ == "__main__":`)'
            raise _given_up(name, chunk, words) from None
        if cost[None] > TRIES * self.count:
            raise _given_up(name, "(none)", "was begun: workers die while they wait") from None


class Foreign:
    """A concurrent.futures executor that the caller made and keeps (threads, processes, MPI)."""

    lost = 0

    def __init__(self, executor):
        self.executor = executor

    def run(self, name, work, inputs, tasks):
        """See the module."""
        blob = pack(inputs)
        key = hashlib.sha256(blob).hexdigest()
        limits = one_thread()  # where the workers are threads of this process
        running = {self.executor.submit(perform_packed, work, key, blob, item, entropy): chunk for chunk, item, entropy in tasks}
        try:
            for future in concurrent.futures.as_completed(running):
                try:
                    result = future.result()
                except concurrent.futures.BrokenExecutor:
                    words = 'was with an executor whose worker died; give executor="processes:N", which replaces workers'
                    raise _given_up(name, running[future], words) from None
                yield running[future], result
        finally:
            for future in running:
                future.cancel()
            limits.restore_original_limits()


class Dask:
    """A dask.distributed cluster, by address or by client. The scheduler gives a dead worker's chunk to another.

    The inputs are the result of a task, so that the scheduler can make them again where their only holder died. dask
    blames a death on every chunk that waited at the worker too, so a chunk that it gives up is given once more.
    """

    def __init__(self, where):
        try:
            import distributed
        except ImportError:
            raise ConfigurationError('a dask scheduler needs dask.distributed; type pip install -e ".[scale]"') from None
        self.library, self.where, self.lost = distributed, where, 0

    def run(self, name, work, inputs, tasks):
        """See the module."""
        own = isinstance(self.where, str)
        client = self._connect() if own else self.where
        blob = pack(inputs)
        key = hashlib.sha256(blob).hexdigest()
        label = f"magjax-{key[:8]}-{uuid.uuid4().hex[:8]}"
        shared, running = {}, {}

        def give(number, attempt):
            if attempt not in shared:
                shared[attempt] = client.submit(bytes, blob, key=f"{label}-inputs-{attempt}")
            _, item, entropy = tasks[number]
            future = client.submit(perform_packed, work, key, shared[attempt], item, entropy, key=f"{label}-{number}-{attempt}")
            running[future.key] = (future, number, attempt)
            return future

        try:
            completed = self.library.as_completed([give(number, 1) for number in range(len(tasks))], loop=client.loop)
            for future in completed:
                _, number, attempt = running.pop(future.key)
                try:
                    result = future.result()
                except self.library.scheduler.KilledWorker:
                    self.lost += 1
                    if attempt == DASK_TRIES:
                        raise _given_up(name, tasks[number][0], "ended every dask worker that it was given to") from None
                    completed.add(give(number, attempt + 1))
                else:
                    yield tasks[number][0], result
        finally:
            client.cancel([future for future, _, _ in running.values()])
            if own:
                client.close()

    def _connect(self):
        try:
            return self.library.Client(self.where, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise ConfigurationError(
                f"no dask scheduler answers at {self.where} ({error}); start one (dask scheduler) and give its address"
            ) from None
