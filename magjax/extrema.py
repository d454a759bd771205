"""The alternating extrema of a field that still matter: the wiping-out property of the Preisach operator, in NumPy."""

import numpy as np


def wiping_stacks(fields):
    """The extrema that still matter after each field of a history, oldest first; one list, changed in place from field to field."""
    stack: list[float] = []
    for value in np.asarray(fields, float).ravel().tolist():
        while len(stack) >= 2 and (value - stack[-1]) * (stack[-1] - stack[-2]) >= 0:
            stack.pop()
        while len(stack) >= 3 and abs(value - stack[-1]) >= abs(stack[-2] - stack[-1]):
            del stack[-2:]
        if not stack or value != stack[-1]:
            stack.append(value)
        yield stack


def wiped(fields) -> list[float]:
    """The alternating extrema of a history of fields that still matter, oldest first, the present field last."""
    last: list[float] = []
    for stack in wiping_stacks(fields):
        last = stack
    return last


def nesting(drive) -> int:
    """How many pairs of extrema a drive can leave in the memory at once, with two to spare."""
    return max((len(stack) for stack in wiping_stacks(drive)), default=1) // 2 + 3
