"""Results to pages: fit.json, diagnosis.json, figures and one offline report.html."""

from .page import rebuild, write_diagnosis, write_fit

__all__ = ["rebuild", "write_diagnosis", "write_fit"]
