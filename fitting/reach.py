"""Where check recordings ask for more field than was fitted, in words."""

from pathlib import Path

BEYOND = 0.01  # of the plane: what noise on the current may add to a drive of the fitted range


def beyond_text(rows) -> str:
    """One sentence on the check recordings whose drive leaves the fitted plane, of rows of `check_errors`; "" where none does."""
    out = [(Path(r["file"]).name, r.get("beyond_plane", 0.0)) for r in rows if r.get("beyond_plane", 0.0) > BEYOND]
    if not out:
        return ""
    named = ", ".join(f"{name} by {100 * share:.0f} %" for name, share in out)
    return f"Beyond the range that was fitted, where the model is saturated: {named}; fit a recording that reaches as far."
