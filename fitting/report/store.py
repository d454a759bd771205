"""The evidence of a report on disk: a nested dict of arrays as one .npz beside the result (no JAX needed to read it).

`unfold` and `fold` turn the nested dict into the flat one that an .npz holds.
"""

from pathlib import Path

import numpy as np

FILE = "report.npz"


def unfold(nested: dict, prefix: str = "") -> dict:
    """Keys joined by "/", floats in single precision."""
    flat = {}
    for key, value in nested.items():
        if isinstance(value, dict):
            flat |= unfold(value, f"{prefix}{key}/")
        else:
            value = np.asarray(value)
            flat[prefix + key] = value.astype(np.float32) if value.dtype == np.float64 and value.ndim else value
    return flat


def fold(flat) -> dict:
    """The nested dict again."""
    nested: dict = {}
    for key in flat:
        *path, last = key.split("/")
        place = nested
        for part in path:
            place = place.setdefault(part, {})
        place[last] = flat[key]
    return nested


def save(folder: Path, evidence: dict) -> None:
    """Write the evidence whole or not at all."""
    partial = Path(folder) / (FILE + ".part")
    try:
        with partial.open("wb") as target:
            np.savez_compressed(target, **unfold(evidence))
        partial.replace(Path(folder) / FILE)
    finally:
        partial.unlink(missing_ok=True)


def load(folder: Path) -> dict:
    """The evidence of a result folder, empty where there is none."""
    path = Path(folder) / FILE
    if not path.exists():
        return {}
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:  # numpy alone leaves a spoiled file open
        return fold({key: stored[key] for key in stored.files})
