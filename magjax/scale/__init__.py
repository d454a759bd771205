"""Work in chunks: a job in this process, on a pool of processes or on dask; interrupted and resumed, the numbers stay.

`Job` is an ordered list of chunks, each a pure function of (inputs, item, seed). `run_job` runs those that the
checkpoint does not hold yet. Nothing here imports JAX except the preparation of a worker.
"""

from .job import Chunk, Job, Outcome, run_job

__all__ = ["Chunk", "Job", "Outcome", "run_job"]
