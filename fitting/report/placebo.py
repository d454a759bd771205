"""The placebo: how often the search finds something in recordings that lack nothing."""

import math

from . import tables
from .page import part, section
from .style import percent, shown, words

RUN_PLACEBO = "To run it: magjax diagnose of these recordings with --placebo 20."


def placebo_section(placebo, verdict):
    """How often the search cries wolf on recordings that lack nothing; or that this was not tried, and how to."""
    title = "Placebo"
    if not placebo:
        if verdict == "data_problem":
            return None
        text = (
            "Not tried. The final model is simulated on the same drives with fresh noise, those recordings are searched as the measured ones "
            "were, and it is counted how often the search adopts an effect though nothing more is there."
        )
        return section(title, part(text=text), part(text=RUN_PLACEBO))
    number, false, table = placebo["runs"], placebo["false_alarms"], "The same search on recordings that lack nothing"
    low, high = interval(false, number)
    share = f"({percent(false / number)}; 95 % interval {percent(low)} to {percent(high)})"
    if placebo.get("procedure") == "search":
        scored = placebo["screening_alarms"]
        text = (
            f"In {false} of {number} sets of recordings simulated from the final model the same search adopted an effect, where nothing more "
            f"was {share}. In {scored} of them something scored above the threshold of the screening and was fitted beside its rivals; in the "
            "others the search ended there by its own rule."
        )
    else:  # a folder written when the screening alone was repeated
        table = "The screening of recordings that lack nothing"
        text = (
            f"In {false} of {number} sets of recordings simulated from the final model something scored above the threshold, where nothing more "
            f"was {share}. Only the screening was repeated: an alarm names nothing yet."
        )
    rows = [[words(str(k)), shown(v)] for k, v in placebo.items()]
    return section(title, part(text=text), part(table=tables.table(table, ["quantity", "value"], rows)))


def interval(hits: int, number: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    z, p = 1.96, hits / number
    centre, half = p + z * z / (2 * number), z * math.sqrt(p * (1 - p) / number + z * z / (4 * number**2))
    scale = 1 + z * z / number
    return max(0.0, (centre - half) / scale), min(1.0, (centre + half) / scale)
