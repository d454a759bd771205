"""Results to pages: fit.json, diagnosis.json, their evidence, figures, and one offline report.html."""

from .page import rebuild
from .write import write_diagnosis, write_fit

__all__ = ["rebuild", "write_diagnosis", "write_fit"]
