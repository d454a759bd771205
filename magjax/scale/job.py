"""A job: an ordered list of chunks, each a pure function of the job's inputs, its own item and its own seed.

The numbers follow from the job alone: chunks are cut by the job, not by the workers, and a chunk's random numbers come
from the job's seed and the chunk's id.
"""

import contextlib
import dataclasses
import importlib.metadata
import time
import zlib
from collections.abc import Callable

import numpy as np

from ..errors import ConfigurationError
from .checkpoint import Checkpoint
from .codec import decode, digest, encode
from .engines import engine


@dataclasses.dataclass(frozen=True)
class Chunk:
    """A piece of the job. `id`: unique in the job, stable between runs; `item`: what the work needs to know, picklable."""

    id: str
    item: object


@dataclasses.dataclass(frozen=True)
class Job:
    """What is to be done: `work(inputs, item, rng) -> numbers, text, arrays, lists, dicts`, once for each chunk.

    `name`: in words, for messages; `work`: a function of a module (workers import it); `inputs`: shared by all chunks,
    picklable dataclasses, arrays, dicts; `seed`: of everything random.
    """

    name: str
    work: Callable
    inputs: object
    chunks: tuple[Chunk, ...]
    seed: int = 0

    def __post_init__(self):
        ids = [c.id for c in self.chunks]
        if len(set(ids)) != len(ids):
            twice = next(i for i in ids if ids.count(i) > 1)
            raise ConfigurationError(f'{self.name}: two chunks are called "{twice}"; give every chunk its own id')

    def entropy(self, chunk: Chunk) -> tuple[int, int]:
        """What a chunk's random numbers start from: the job's seed and its id."""
        return int(self.seed), zlib.crc32(chunk.id.encode())

    def header(self) -> dict:
        """What tells this job from others in a checkpoint."""
        versions = {p: importlib.metadata.version(p) for p in ("jax", "numpy")}
        return {"job": self.name, "seed": int(self.seed), "inputs": digest(self.work, self.inputs), **versions}


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Results in the order of the chunks. `resumed`: taken from the checkpoint; `lost`: workers that died and were replaced."""

    results: list
    resumed: int
    lost: int
    seconds: float

    def __str__(self):
        words = [f"{len(self.results)} chunks in {self.seconds:.1f} s"]
        if self.resumed:
            words.append(f"{self.resumed} from the checkpoint")
        if self.lost:
            words.append(f"{self.lost} worker{'s' if self.lost > 1 else ''} lost and replaced")
        return ", ".join(words)


def run_job(job: Job, executor=None, *, checkpoint=None, progress=None) -> Outcome:
    """Run what the checkpoint does not hold yet.

    `executor`: None (this process), "processes:N", "dask:ADDRESS", a dask.distributed Client or a concurrent.futures
    Executor. `checkpoint`: file; a job that was killed goes on where it was. `progress`: called as progress(text,
    chunks done, None). Raises what the work raises, `ConfigurationError` for a wrong executor, a checkpoint of another
    job, or a chunk that killed its worker three times.
    """
    begin = time.perf_counter()
    runner = engine(executor)
    total = len(job.chunks)
    items = [digest(c.item) for c in job.chunks]
    found: dict[str, object] = {}
    with contextlib.ExitStack() as stack:
        store = None
        if checkpoint is not None:
            store = stack.enter_context(Checkpoint(checkpoint, job.header()))
            found = {c.id: store.done[c.id, d] for c, d in zip(job.chunks, items, strict=True) if (c.id, d) in store.done}
        resumed = len(found)
        digests = {c.id: d for c, d in zip(job.chunks, items, strict=True)}
        tasks = [(c.id, c.item, job.entropy(c)) for c in job.chunks if c.id not in found]
        if tasks:
            finished = stack.enter_context(contextlib.closing(runner.run(job.name, job.work, job.inputs, tasks)))
            for chunk, result in finished:
                if store is not None:
                    store.add(chunk, digests[chunk], result)
                found[chunk] = result
                if progress is not None:
                    progress(f"{job.name}, {total} chunks", len(found), None)
    return Outcome([decode(found[c.id]) for c in job.chunks], resumed, runner.lost, time.perf_counter() - begin)


def perform(work, inputs, item, entropy):
    """One chunk, wherever it runs: the encoded result. BLAS must have one thread meanwhile (`worker.one_thread`)."""
    return encode(work(inputs, item, np.random.default_rng(np.random.SeedSequence(entropy))))
