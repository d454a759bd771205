"""Numbers, colours and the SVG as the reports write them."""

import re
from pathlib import Path

import numpy as np
import pytest

from fitting.report import loops, style
from fitting.report.page import kept_together
from fitting.report.style import percent, plain, short_path, to_svg, unit_text, words
from fitting.report.tables import aligned, checks, correlations, table, to_error


def test_numbers_as_people_write_them():
    assert [plain(v) for v in (0, 0.5, -12345.6, 7.87e5, -2.83e-5, None, float("nan"))] == [
        "0",
        "0.5",
        "−12300",
        "7.87e5",
        "−2.83e−5",
        "–",
        "–",
    ]
    assert plain(100000.0) == "1e5" and plain(float("inf")) == "∞"
    assert [percent(s) for s in (0, 0.004, 0.25, 0.995, 1.0, float("nan"))] == ["0 %", "< 1 %", "25 %", "> 99 %", "100 %", "–"]


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [(61.98871, 0.0652, "61.989"), (404.857, 2.4, "404.9"), (0.8096, 0.3, "0.81"), (5.0, 0.0, "5"), (0.001, 2.0, "0.001")],
)
def test_values_to_the_second_digit_of_their_error(value, error, text):
    assert to_error(value, error) == text


LONG = "rate dependent switching and quartic magnetostriction and reversible magnetization"


@pytest.mark.parametrize("panels", [1, 2, 3])
@pytest.mark.parametrize("added", ["", "creep", "second eddy path", "rate dependent switching", "creep and delta e", LONG])
def test_a_legend_of_long_names_stays_in_its_figure_and_off_the_headings(monkeypatch, panels, added):
    """Of two check recordings its end was cut off."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    phase, drawn = np.arange(8) / 8, []
    row = {"name": "check.csv", "drive": np.sin(phase), "phase": phase, "noise": np.ones(8), **{k: phase for k in ("measured", "before", "after")}}
    rows = [{"rms_before": 2e-7, "rms_after": 1e-7, "noise_rms": 4e-8}] * panels
    monkeypatch.setattr(loops, "picture", lambda figure, *words: drawn.append(figure))
    loops.checks({str(k): row for k in range(panels)}, "displacement", "current", rows, added=added)
    figure = drawn[0]
    renderer = FigureCanvasAgg(figure).get_renderer()
    legend = figure.legends[0].get_window_extent(renderer)
    heading = max(axes.get_tightbbox(renderer).y1 for axes in figure.axes)
    assert legend.x1 <= figure.bbox.x1 and heading < legend.y0


@pytest.mark.parametrize(("repaired", "names"), [(False, ["measured", "predicted"]), (True, ["measured", "before", "after"])])
def test_a_check_recording_is_predicted_not_fitted(monkeypatch, repaired, names):
    phase, drawn = np.arange(8) / 8, []
    row = {"name": "check.csv", "drive": np.sin(phase), "phase": phase, "noise": np.ones(8), **{k: phase for k in ("measured", "before", "after")}}
    monkeypatch.setattr(loops, "picture", lambda figure, *words: drawn.append(figure))
    loops.checks({"0": row}, "displacement", "current", [{"rms_before": 2e-7, "rms_after": 1e-7, "noise_rms": 4e-8}], repaired)
    assert [text.get_text() for text in drawn[0].legends[0].get_texts()] == [*names, "twice the noise of the mean"]


def test_text_stands_out_from_its_ground():
    """WCAG: 4.5 for text, 3 for lines that carry meaning."""

    def luminance(colour):
        parts = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
        linear = np.where(parts <= 0.03928, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    def contrast(a, b):
        light, dark = sorted((luminance(a), luminance(b)), reverse=True)
        return (light + 0.05) / (dark + 0.05)

    page = (style.__file__).replace("style.py", "page.html")
    css = Path(page).read_text(encoding="utf-8")
    grounds = ["#ffffff", *(g for g in re.findall(r"background:(#[0-9a-f]{6})", css))]
    assert len(grounds) >= 5
    for colour in ("#1a1a1a", "#444444", "#0a4d80", style.INK, style.MUTED):
        assert all(contrast(colour, g) > 4.5 for g in grounds)
    assert all(contrast(c, "#ffffff") > 3 for c in (style.MEASURED, style.MODEL, style.GREEN))


def test_short_paths_are_the_same_line():
    rng = np.random.default_rng(1)
    points = np.cumsum(rng.normal(0, 3, (400, 2)), axis=0) + 150
    text = "M " + "\nL ".join(f"{x:.6f} {y:.6f}" for x, y in points) + "\nz\nM 1.5 2.5\nL 3 4"
    short = short_path(text)
    assert len(short) < 0.55 * len(text) and short.endswith("zM1.5 2.5l1.5 1.5")
    steps = [tuple(map(float, p.split())) for p in re.findall(r"[Ml]([-\d.]+ [-\d.]+)", short.split("z")[0])]
    again = np.cumsum(np.array(steps), axis=0)
    kept = [tuple(np.round(20 * p)) for p in points]
    distinct = [k for i, k in enumerate(kept) if i == 0 or k != kept[i - 1]]
    assert len(again) == len(distinct)
    assert np.abs(again - np.array(distinct) / 20).max() < 0.026  # one rounding, no drift
    curve = "M 0 -1.581139 \nC 0.419323 -1.581139 0.821531 -1.41454 1.118034 -1.118034"
    assert short_path(curve) == "M 0 -1.58 C 0.41 -1.58 0.82 -1.41 1.11 -1.11"


def test_svg_has_text_name_and_description():
    with style.styled():
        figure = style.canvas(4, 3)
        axes = figure.add_axes([0.2, 0.2, 0.7, 0.7])
        axes.plot([0, 1], [0.00125, 0.00375])
        axes.set_title("5 < 6 & so on")
        svg = to_svg(figure, "stem", 'a "title" & more', "what < is seen")
        again = to_svg(figure, "stem", 'a "title" & more', "what < is seen")
    assert svg == again
    assert ">5 &lt; 6 &amp; so on</text>" in svg and "0.00125" not in svg.split("<text")[0]
    assert 'role="img" aria-label="a &quot;title&quot; &amp; more" aria-describedby="stem-desc"' in svg
    assert '<desc id="stem-desc">what &lt; is seen</desc>' in svg and "<metadata" not in svg
    labels = re.findall(r">([^<>]+)</text>", svg)
    assert "0.0020" in labels or "0.002" in labels or any("2.0" in x for x in labels)  # numbers in text are not cut short


def test_correlations_mark_the_strong():
    made = correlations({"correlations": {"a~b": 0.95, "a~c": -0.2, "b~c": 0.0}})
    assert made["rows"][0] == ["a", "1.00", "0.95 strong", "−0.20"] and "strong" in made["note"]
    assert correlations({"correlations": {}}) is None


def test_numbers_of_a_column_have_the_same_decimals_and_stand_to_the_right():
    assert aligned([[46.8], [0.6], [48.0]]) == [["46.8"], ["0.6"], ["48.0"]]
    assert aligned([[0.9, 1.4], [None, 2.326]]) == [["0.90", "1.40"], ["–", "2.33"]]
    assert aligned([[16.4], [0.78]], least=2) == [["16.40"], ["0.78"]]
    assert aligned([[5e-5], [2.0]]) == [["5e−5"], ["2"]]  # too far apart
    rows = [["a", "43.2 nm", "2.9 to 3.1", "−1.2e−5 m s/A", "creep", "b = 2"], ["b", "–", "1 to 2", "", "1 drift", "not fitted"]]
    assert table("", "abcdef", rows)["right"] == [False, True, False, True, False, False]
    assert table("", ["question", "answer"], [["x", "1"]])["right"] == [False, False]


def test_what_belongs_together_is_not_parted():
    assert kept_together("43.2 nm") == "43.2\u00a0nm" and kept_together("< 1 %").endswith("1\u00a0%")
    assert kept_together("b = 2 ± 0.1") == "b = 2\u00a0±\u00a00.1" and kept_together("0.8 1/A") == "0.8\u00a01/A"
    assert kept_together("29.4 to 32.2") == "29.4 to 32.2"


def test_names_and_units_as_people_write_them():
    assert [words(n) for n in ("delta_e", "duffing_stiffness", "coulomb_friction", "second_mode")] == [
        "ΔE effect",
        "Duffing stiffness",
        "Coulomb friction",
        "second mode",
    ]
    assert unit_text("A/m (s/T)^0.5") == "A/m √(s/T)" and unit_text("m^2") == "m²"


def test_the_error_beyond_the_noise_has_its_formula():
    row = {"file": "c.csv", "unit": "m", "rms_before": 5e-8, "rms_after": 3e-8, "noise_rms": 4e-8, "beyond_plane": 0.0}
    made = checks([row])
    assert made["rows"] == [["c.csv", "50.0", "30.0", "40.0", "30.0", "0.0", "nm"]] and "√(rms error² − noise rms²)" in made["note"]
