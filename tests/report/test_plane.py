"""The picture of the Preisach plane: cells that no recording switches are hatched, and counted in words."""

import re

import numpy as np
import pytest

from fitting.report.plane import mass_map

L = 12


def drawn(seen, known=True):
    """The picture of a plane whose cells are `seen` or not."""
    masses = np.tril(np.ones((L, L)))
    errors = np.full((L, L), 0.1 if known else np.nan)
    return mass_map({"plane": {"masses": masses, "errors": errors, "seen": seen, "levels": np.linspace(-1e3, 5e3, L + 1)}})


def hatched(svg):
    """Where each hatched region lies in its panel: left, right, bottom, top in cells."""
    axes = [[float(v) for v in m] for m in re.findall(r"M([\d.]+) ([\d.]+)l(\d{3}[\d.]*) -\3\"", svg)]  # the diagonals
    found = []
    for path in re.findall(r'<path d="([^"]*)"[^>]*style="fill: url\(#', svg):
        steps = np.array(re.findall(r"-?\d+\.?\d*", path), float).reshape(-1, 2)
        x, y = np.cumsum(steps, axis=0).T
        left, bottom, width = next(a for a in reversed(axes) if a[0] <= x.min() + 1)
        found.append(np.array([x.min() - left, x.max() - left, bottom - y.max(), bottom - y.min()]) * L / width)
    return found


@pytest.mark.parametrize("known", [True, False])
def test_cells_never_switched_are_hatched(known):
    seen = np.tril(np.ones((L, L)))
    seen[8:, 2:5] = 0  # alpha in the four uppermost rows, beta in the third to fifth column
    picture = drawn(seen, known)
    regions = hatched(picture.svg)
    assert len(regions) == (2 if known else 1)  # on the masses and, where they are known, on their errors
    for region in regions:
        assert region == pytest.approx([2, 5, 8, 12], abs=0.02)
    assert "Hatched: the 12 cells that no recording switches" in picture.caption


def test_a_single_cell_is_hatched():
    seen = np.tril(np.ones((L, L)))
    seen[7, 3] = 0
    (region,) = hatched(drawn(seen, known=False).svg)
    assert region == pytest.approx([3, 4, 7, 8], abs=0.02)


def test_a_plane_switched_everywhere_has_no_hatching():
    picture = drawn(np.tril(np.ones((L, L))))
    assert not hatched(picture.svg) and "pattern" not in picture.svg
    assert "Every cell is switched" in picture.caption
