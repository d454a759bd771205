"""Recordings in which nothing moves: left out where the others say that next to nothing does, as below a threshold of the strain or
within a play; a data problem where they say that it must."""

import numpy as np

from magjax.errors import RecordingError
from magjax.recording import NO_ANSWER, follows_nothing
from magjax.words import sized

from .check import check_errors

FEW = 4  # recordings for each one that may be left out
NEXT_TO_NOTHING = 0.05  # of the others' motion, rms, that the plain model may ask of one of them
TEXT = "Nothing but noise moves in {names}, which is left out: the plain model of the others asks for {asked} rms there, and they move by {usual}."


def moving_and_still(recordings, bench) -> tuple[list, list]:
    """The recordings in which the reading follows the drive, and those in which it does not, where these are few; else (all, [])."""
    moving, still = [], []
    for r in recordings:
        nothing = r.frequency() is not None and follows_nothing(r, bench.output)
        (still if nothing else moving).append(r)
    return (moving, still) if still and len(moving) >= FEW * len(still) else (list(recordings), [])


def word_on(plain, moving, still, bench) -> str:
    """What is said of those that are left out, by the plain fit of the others; raises `RecordingError` where it asks for motion there."""
    rows = check_errors(plain.actuator, plain.actuator, still, bench)
    usual = float(np.median([np.std(r.channels[bench.output]) for r in moving]))
    asked = [np.sqrt(max(row["rms_before"] ** 2 - row["noise_rms"] ** 2, 0.0)) for row in rows]
    for recording, rms in zip(still, asked, strict=True):
        if not rms < NEXT_TO_NOTHING * usual:
            raise RecordingError(f"{recording.name}: {NO_ANSWER.format(channel=bench.output, drive=recording.drive)}")
    names = " and ".join(r.name for r in still)
    asked, usual = (sized(rows[0]["unit"], x) for x in (max(asked), usual))
    return TEXT.format(names=names, asked=asked, usual=usual)
