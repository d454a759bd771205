"""Every report: one file, offline, without script, small, well formed, and told to those who hear it."""

import dataclasses
import html.parser
import json
import os
import re
import shutil
import subprocess
import sys
import xml.dom.minidom

import numpy as np
import pytest

from fitting.locate import where
from fitting.report import rebuild, store, write_diagnosis, write_fit
from fitting.report.banner import headline, tone
from fitting.report.diagnosis_page import _shifts, diagnosis_page
from fitting.report.fit_page import diagnose_command, sentence, validity
from fitting.report.learned import learned_function
from fitting.report.loops import inside, loops
from fitting.report.named import size_of
from fitting.report.page import kept_together
from fitting.report.placebo import interval, placebo_section
from fitting.report.plane import never_switched, told
from fitting.report.residuals import repeating, strokes
from fitting.report.tables import interval as interval_of
from fitting.report.tables import recordings as recordings_table
from fitting.report.tables import to_error
from fitting.screen import Candidate
from magjax.errors import ConfigurationError
from magjax.readers import load_sound
from tests.report.conftest import WITH_PNG

VOID = {"meta", "link", "br", "img", "hr", "input"}


class Outline(html.parser.HTMLParser):
    """Elements with their attributes and text; refuses tags that do not close."""

    def __init__(self, text):
        super().__init__()
        self.open, self.elements, self.closed = [], [], True
        self.feed(text)
        self.close()
        assert not self.open, f"left open: {self.open}"

    def handle_starttag(self, tag, attributes):
        self.elements.append([tag, dict(attributes), "", [t for t, _ in self.open]])
        if tag not in VOID:
            self.open.append((tag, len(self.elements) - 1))

    def handle_startendtag(self, tag, attributes):
        self.elements.append([tag, dict(attributes), "", [t for t, _ in self.open]])

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open and self.open[-1][0] == tag, f"</{tag}> closes {self.open[-1:]}"
            self.open.pop()

    def handle_data(self, data):
        for _, index in self.open:
            self.elements[index][2] += data

    def all(self, *tags):
        return [e for e in self.elements if e[0] in tags]


@pytest.fixture(autouse=True)
def no_second_drawing(monkeypatch):
    """Pages that a test makes by itself are looked at as SVG; the folders' figures are written before."""
    monkeypatch.setattr("fitting.report.style.to_png", lambda figure: b"")


def test_is_one_small_file_that_points_nowhere(html):
    assert len(html.encode()) < 1_000_000
    outline = Outline(html)
    assert not outline.all("script", "iframe", "object", "embed", "img")
    for tag, attributes, _, _ in outline.elements:
        for key, value in attributes.items():
            assert not key.startswith("on"), f"{tag} {key}"
            if key in ("href", "src", "xlink:href", "action", "data"):
                assert value.startswith(("#", "data:")), f"{tag} {key}={value[:60]}"
            elif "url(" in (value or ""):
                assert "url(#" in value
    rest = html.replace("http://www.w3.org/2000/svg", "").replace("http://www.w3.org/1999/xlink", "")
    assert "http://" not in rest and "https://" not in rest and "@import" not in html


def test_reads_in_order(html):
    outline = Outline(html)
    levels = [int(e[0][1]) for e in outline.all("h1", "h2", "h3", "h4")]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(b <= a + 1 for a, b in zip(levels, levels[1:], strict=False)), levels
    assert all(e[2].strip() for e in outline.all("h1", "h2", "h3"))
    root = outline.all("html")[0][1]
    assert root["lang"] == "en" and len(outline.all("main")) == 1
    ids = [e[1]["id"] for e in outline.elements if "id" in e[1]]
    assert len(ids) == len(set(ids)), "ids are not unique"
    for tag, attributes, _, _ in outline.elements:
        for key in ("aria-labelledby", "aria-describedby"):
            assert attributes.get(key, ids[0]) in ids, f"{tag} {key}"
        link = attributes.get("href") or attributes.get("xlink:href") or ""
        assert not link.startswith("#") or link[1:] in ids, f"{tag} {link}"
    skip = outline.all("a")[0]
    assert skip[1]["href"] == "#result" and "skip" in skip[1]["class"]


def test_every_figure_and_table_has_words(html, kind):
    outline = Outline(html)
    for _, attributes, text, parents in outline.all("svg"):
        assert attributes["role"] == "img" and len(attributes["aria-label"]) > 5 and "figure" in parents
        assert attributes["aria-describedby"].endswith("-desc")
    assert len(outline.all("figcaption")) == len(outline.all("figure")) == len(outline.all("svg"))
    assert all(len(e[2]) > 30 for e in outline.all("figcaption", "desc"))
    assert len(outline.all("caption")) == len(outline.all("table"))
    assert all(e[2].strip() and "scope" in e[1] for e in outline.all("th"))
    captions = [e[2] for e in outline.all("caption")]
    assert len(captions) == len(set(captions))
    expected = {
        "fit": 10,
        "poor": 10,
        "attributed": 12,
        "group": 12,
        "unknown_at": 10,
        "nothing_missing": 10,
        "data_problem": 1,
        "unsettled": 1,
        "unreadable": 0,
    }
    assert len(outline.all("svg")) >= expected[kind]


def test_names_are_escaped(folders):
    page = (folders["fit"] / "report.html").read_text(encoding="utf-8")
    assert "rec &lt;b&gt;" in page and "rec <b>" not in page


def test_svg_files_are_well_formed_and_nothing_is_half_written(folders, kind):
    for path in (folders[kind] / "figures").glob("*.svg"):
        xml.dom.minidom.parse(str(path))
        image = path.with_suffix(".png").read_bytes() if kind in WITH_PNG else None
        assert image is None or (image[:4] == b"\x89PNG" and int.from_bytes(image[16:20], "big") > 500)  # pixels across
    assert not list(folders[kind].rglob("*.part"))


def test_rebuilds_without_jax_and_tells_what_it_draws(folders, tmp_path):
    for kind in ("fit", "attributed"):
        copy = tmp_path / kind
        shutil.copytree(folders[kind], copy)
        (copy / "report.html").unlink()
        code = (
            f"import sys; from fitting.report import rebuild; said = []; rebuild({str(copy)!r}, said.append); "
            "assert 'jax' not in sys.modules and len(said) > 8 and all(s.startswith('report: ') for s in said), said"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert (copy / "report.html").read_bytes() == (folders[kind] / "report.html").read_bytes()


def test_rebuilds_from_the_numbers_alone(folders, tmp_path):
    """A folder whose evidence was lost still gives its tables."""
    for kind in ("fit", "attributed"):
        name = "fit.json" if kind == "fit" else "diagnosis.json"
        place = tmp_path / kind
        place.mkdir()
        shutil.copy(folders[kind] / name, place / name)
        page = rebuild(place).read_text(encoding="utf-8")
        assert page.count("<svg") <= 2 and "coil.R_eddy" in page  # ranking and convergence need the JSON alone
    with pytest.raises(ConfigurationError, match="fit.json"):
        rebuild(tmp_path)
    (place / "diagnosis.json").write_text("{")
    with pytest.raises(ConfigurationError, match="not valid JSON"):
        rebuild(place)
    (place / "diagnosis.json").write_text('{"base": {}}')
    with pytest.raises(ConfigurationError, match="is no result"):
        rebuild(place)
    (place / "diagnosis.json").write_bytes(b"\xff\xfe{")
    with pytest.raises(ConfigurationError, match="not valid JSON"):
        rebuild(place)
    shutil.copy(folders["fit"] / "fit.json", place / "fit.json")  # the page is that of the result that was written last
    os.utime(place / "diagnosis.json", ns=(0, 0))
    assert "coil.R_eddy" in rebuild(place).read_text(encoding="utf-8")


def test_a_fit_that_broke_down_still_has_a_page(folders, tmp_path):
    """Its file has null for what is no number."""
    content = json.loads((folders["fit"] / "fit.json").read_text())
    content |= {"chi2_per_sample": None, "bic": None, "effective_unknowns": None}
    for row in content["parameters"].values():
        row["stderr"] = None if row["free"] else row["stderr"]
    (tmp_path / "fit.json").write_text(json.dumps(content))
    assert "coil.R_eddy" in rebuild(tmp_path).read_text(encoding="utf-8")


def test_names_are_drawn_as_they_are():
    import io

    from fitting.report.style import canvas, styled

    drawn = io.StringIO()
    with styled():
        figure = canvas(2, 2)
        for k, name in enumerate(("a$b^{_$.csv", "cost$5$_x^2.csv")):
            figure.text(0.1, 0.3 * k, name)
        figure.savefig(drawn, format="svg")
    assert ">a$b^{_$.csv</text>" in drawn.getvalue() and ">cost$5$_x^2.csv</text>" in drawn.getvalue()


def test_the_banner_of_a_fit(folders):
    good, bad = ((folders[k] / "report.html").read_text(encoding="utf-8") for k in ("fit", "poor"))
    assert "the error bars hold" in good and 'class="banner good"' in good and "not valid" not in good
    assert 'class="banner bad"' in bad and "std. error (not valid)" in bad
    said = Outline(bad).all("section")[0][2].lower()
    assert said.count("raise") == said.count("start nearer") == 1 and "--max-jacobians" in said
    fit = json.loads((folders["fit"] / "fit.json").read_text())
    assert validity(fit)[3] == ""
    tone, said, advice, doubt = validity({**fit, "chi2_per_sample": 9.0})
    assert tone == "bad" and "3 times its noise" in said and "diagnosis" in advice and doubt == "not valid"
    assert validity({**fit, "chi2_per_sample": float("nan")})[0] == "bad"
    assert validity({**fit, "converged": False})[0] == "bad"
    assert validity({**fit, "chi2_per_sample": 1.4})[0::3] == ("warn", "too narrow")
    alone = [{**fit["recordings"][0], "file": "runs/rec_9.csv", "chi2_per_sample": 1.84}, *fit["recordings"][1:]]
    assert "in rec_9.csv (χ²/N = 1.84)" in validity({**fit, "recordings": alone})[1]
    assert "assumed" in validity({**fit, "chi2_per_sample": 0.2})[1]
    assert "<td>yes</td>" in good and "<td>yes (errors not valid)</td>" in bad and "is below 30 % (errors not valid)" in bad
    bound = {**fit["parameters"], "mechanics.xi": {**fit["parameters"]["mechanics.xi"], "at_bound": True}}
    assert "mechanics.xi" in validity({**fit, "parameters": bound})[1]
    loose = {**fit["parameters"], "mechanics.xi": {**fit["parameters"]["mechanics.xi"], "identified": False}}
    assert "not identified: mechanics.xi" in validity({**fit, "parameters": loose})[1]


def test_a_bad_fit_says_the_command_that_follows(folders, tmp_path):
    fit = json.loads((folders["fit"] / "fit.json").read_text()) | {"chi2_per_sample": 9.0}
    (tmp_path / "fit.json").write_text(json.dumps(fit))
    page = rebuild(tmp_path).read_text(encoding="utf-8")
    assert "<code>magjax diagnose rec_*.csv --bench aa-050h --out result-diagnosis</code>" in page  # not over the fit
    fit["message"] = "what repeats is 3 times its noise; run magjax diagnose on the same files"
    for reproduce, command in ((fit["reproduce"], True), ("magjax demo --seed 0", False)):
        (tmp_path / "fit.json").write_text(json.dumps({**fit, "reproduce": reproduce}))
        banner = Outline(rebuild(tmp_path).read_text(encoding="utf-8")).all("section")[0][2]
        assert banner.count("on the same files") == 1 and ("--bench" in banner) == command


@pytest.mark.parametrize(
    ("fit", "diagnosis"),
    [
        ("magjax fit a.csv b.csv --bench x", "magjax diagnose a.csv b.csv --bench x"),
        ("magjax fit a.csv --out=made/ --model old", "magjax diagnose a.csv --out=made-diagnosis --model old"),
        ("magjax fit 'my a.csv' --out 'my fit/' --quiet", "magjax diagnose 'my a.csv' --out 'my fit-diagnosis' --quiet"),
        ("magjax fit --cells 25 a.csv --bootstrap=9 --check c.csv", "magjax diagnose a.csv --check c.csv"),
        ("magjax fit --fleet one two --out all", ""),
        ("magjax demo --seed 0", ""),
        ("", ""),
    ],
)
def test_the_command_of_the_diagnosis_is_one_that_can_be_given(fit, diagnosis):
    assert diagnose_command(fit) == diagnosis


def test_the_verdict_comes_first_and_in_plain_words(folders, diagnoses):
    for kind, found in diagnoses.items():
        page = Outline((folders[kind] / "report.html").read_text(encoding="utf-8"))
        first = next(e for e in page.elements if e[1].get("class") == "head")
        assert first[2] == headline(found.as_dict()) and "_" not in re.sub(r"\S+[.]csv", "", first[2])
    assert "amplifier lag" in headline(diagnoses["attributed"].as_dict())
    assert "cannot say which" in headline(diagnoses["group"].as_dict())
    assert "sensor" in headline(diagnoses["unknown_at"].as_dict())


def test_a_silent_headline_says_what_is_left(diagnoses, folders, tmp_path):
    found = diagnoses["nothing_missing"].as_dict()
    good = {**found, "base": {**found["base"], "chi2_per_sample": 1.0, "recordings": [{"chi2_per_sample": 1.2}]}}
    assert headline(good) == "Nothing is missing: the model meets the recordings to their noise" and tone(good) == "good"
    cut = {**good, "ended_after": 15.0}
    assert headline(cut) == "No effect of the catalogue was found; the limit of time came before all was tried" and tone(cut) == "warn"
    for wrong, said in (
        ({"base": {**good["base"], "chi2_per_sample": 1.31}}, "χ²/N = 1.31 is left"),
        (
            {"base": {**good["base"], "recordings": [{"chi2_per_sample": 2.5, "file": "a/r1.csv"}]}},
            "(17 of 20 could be judged); r1.csv is left with a misfit of χ²/N = 2.5",
        ),
        ({"check": [{"rms_after": 1.32e-7, "noise_rms": 4.9e-8, "unit": "m"}]}, "missed by 132 nm (noise 49 nm)"),
    ):
        judged = [{"name": f"e{k}"} for k in range(20)]
        bad = good | {"candidates": judged, "absorbed": ["e1", "e2", "e3", "zero_drift"]} | wrong
        assert (
            headline(bad).startswith("No effect of the catalogue was found (17 of 20 could be judged); ")
            and said in headline(bad)
            and tone(bad) == "warn"
        )
    stored = json.loads((folders["nothing_missing"] / "diagnosis.json").read_text())
    stored["base"]["chi2_per_sample"] = 1.31
    (tmp_path / "diagnosis.json").write_text(json.dumps(stored))
    page = rebuild(tmp_path).read_text(encoding="utf-8")
    assert 'class="banner warn"' in page and "the model meets" not in page


def test_what_was_found_beside_a_group_is_in_its_headline_and_its_leader_has_shifts(diagnoses):
    found = diagnoses["group"].as_dict()
    beside = {**diagnoses["attributed"].effects[0], "name": "second_mode", "block": "mechanics"}
    assert headline(found | {"effects": [beside]}) == headline(found) + "; found beside it: second mode (mechanics)"
    told = json.dumps(_shifts(found), ensure_ascii=False)
    base, repaired = (found[k]["parameters"]["coil.R_eddy"] for k in ("base", "repaired"))
    assert to_error(base["value"], repaired["stderr"]) in told and to_error(repaired["value"], repaired["stderr"]) in told
    assert f"if the leading rival is right: {found['groups'][0][0].replace('_', ' ')}" in told
    rows = _shifts(found | {"effects": [beside, {**beside, "name": "creep"}]})["parts"][0]["table"]["rows"]
    assert [row[0] for row in rows] == list(beside["shifts"])  # each constant once, however many effects


def test_the_ranking_says_what_a_fit_did_and_no_power_of_what_is_absorbed(diagnoses, folders, tmp_path):
    found = json.loads((folders["attributed"] / "diagnosis.json").read_text())
    found["candidates"][1]["achieved_chi2_drop"] = -947.0
    found["absorbed"] = [found["candidates"][2]["name"]]
    shutil.copy(folders["attributed"] / "report.npz", tmp_path)
    (tmp_path / "diagnosis.json").write_text(json.dumps(found))
    page = rebuild(tmp_path).read_text(encoding="utf-8")
    assert page.count("rose by 947") == 2 and "−947" not in page and "by −" not in page
    rows = [[cell for cell in re.findall(r"<t[hd][^>]*>([^<]*)</t[hd]>", row)] for row in re.findall("<tr>.*?</tr>", page)]
    power = {row[0]: row[6] for row in rows if len(row) == 10}
    name = found["absorbed"][0].replace("_", " ")
    assert power[name] == "–" and sum(p.endswith("%") for p in power.values()) > 10


def test_what_was_scored_at_a_finite_amplitude_has_no_visible_one(folders, tmp_path):
    found = json.loads((folders["attributed"] / "diagnosis.json").read_text())
    first, second, third, *_ = found["candidates"]
    first |= {"amplitude": 0.5, "smallest_visible": 0.5, "tried_at": 0.5}
    second |= {"amplitude": 1.24, "smallest_visible": 1.24}
    del second["tried_at"]  # as it was stored before it was told
    third |= {"z": 0.0, "amplitude": -0.001}
    shutil.copy(folders["attributed"] / "report.npz", tmp_path)
    (tmp_path / "diagnosis.json").write_text(json.dumps(found))
    page = rebuild(tmp_path).read_text(encoding="utf-8")
    rows = [re.findall(r"<t[hd][^>]*>([^<]*)</t[hd]>", row) for row in re.findall("<tr>.*?</tr>", page)]
    said = {row[0]: row[4:7] for row in rows if len(row) == 10}
    for c, size in ((first, "tried at 0.5"), (second, "tried at 1.24")):
        assert said[c["name"].replace("_", " ")][0].startswith(size) and said[c["name"].replace("_", " ")][1:] == ["–", "–"]
    assert "no mark to first order" in page and "the sign that the effect cannot have" in page
    plain_page = (folders["attributed"] / "report.html").read_text(encoding="utf-8")
    assert "no mark to first order" not in plain_page and "cannot have" not in plain_page


def test_each_rival_says_why_it_is_not_told_from_the_best(folders, tmp_path):
    found = json.loads((folders["group"] / "diagnosis.json").read_text())
    names = found["groups"][0]
    assert "why it is in the group" not in (folders["group"] / "report.html").read_text(encoding="utf-8")  # where it is not known
    whys = ("", "it meets the noise too, 30 in chi2 behind")
    found["ties"] = {n: {"chi2_per_sample": 1.03 + k, "why": why} for k, (n, why) in enumerate(zip(names, whys, strict=True))}
    (tmp_path / "diagnosis.json").write_text(json.dumps(found))
    page = rebuild(tmp_path).read_text(encoding="utf-8")
    for said in (
        '<td class="n">1.03</td><td>the best</td>',
        '<td class="n">2.03</td><td>it meets the noise too, 30 in χ² behind</td>',
    ):
        assert said in page
    assert "about as well as the others" not in page


def test_a_group_beside_an_unknown_or_a_misfit_repairs_nothing(folders, tmp_path):
    found = json.loads((folders["group"] / "diagnosis.json").read_text())
    part = "takes the same part of the misfit"
    for verdict, left, does in (("group", 1.03, "repairs the model"), ("group", 7.7, part), ("unknown_at", 1.03, part)):
        found["repaired"]["chi2_per_sample"] = left
        unknown = {"block": "sensor", "region": "", "explained_share": 0.5} if verdict == "unknown_at" else None
        (tmp_path / "diagnosis.json").write_text(json.dumps({**found, "verdict": verdict, "unknown": unknown}))
        assert f"Each of these {does}, and to name one" in rebuild(tmp_path).read_text(encoding="utf-8")


def test_loops_say_what_was_added_and_what_the_band_is(diagnoses, folders, tmp_path):
    found = json.loads((folders["attributed"] / "diagnosis.json").read_text())
    found["repaired"]["parameters"]["effects.excess_loss.k"] = {**found["repaired"]["parameters"]["mechanics.xi"], "unit": "1"}
    shutil.copy(folders["attributed"] / "report.npz", tmp_path)
    (tmp_path / "diagnosis.json").write_text(json.dumps(found))
    page = rebuild(tmp_path).read_text(encoding="utf-8")
    assert page.count(">after, with excess loss</text>") == 2 and page.count(">twice the noise of the mean</text>") == 2
    assert ">1</td>" not in page.split("Parameters of the repaired model")[2].split("</table>")[0]  # a number has no unit


def test_a_fit_says_how_many_cells_were_never_switched(folders):
    evidence = store.load(folders["fit"])
    said = never_switched(evidence)
    assert told(evidence, {"density": "hats on 18 x 13 knots"}) == f"The density is made of hats on 18 x 13 knots. {said}" and told(evidence, {}) == said
    assert said and said in (folders["fit"] / "report.html").read_text(encoding="utf-8")
    lower = np.tril(np.ones((4, 4), bool))
    assert never_switched({"plane": {"seen": lower}}).startswith("Every one of the 10 cells is switched")
    assert never_switched({"plane": {"seen": lower & ~np.eye(4, dtype=bool)}}).startswith("4 of 10 cells were never switched")
    assert never_switched({}) == ""


def test_an_interval_ends_at_the_bounds_of_its_parameter(folders, tmp_path):
    assert interval_of({"value": 5.9, "stderr": 3.2}, 0.0) == "0 (bound) to 12.2"
    assert interval_of({"value": 0.9, "stderr": 0.1}, 0.0, 1.0) == "0.7 to 1 (bound)"
    assert interval_of({"value": 5.9, "stderr": 3.2}) == "−0.37 to 12.2"
    fit = json.loads((folders["fit"] / "fit.json").read_text())
    fit["parameters"]["mechanics.xi"]["stderr"] = 2.0
    shutil.copy(folders["fit"] / "report.npz", tmp_path)
    (tmp_path / "fit.json").write_text(json.dumps(fit))
    assert "0 (bound) to 4" in rebuild(tmp_path).read_text(encoding="utf-8")


def test_a_diagnosis_shows_its_grounds(folders, diagnoses):
    page = (folders["attributed"] / "report.html").read_text(encoding="utf-8")
    heads = [e[2] for e in Outline(page).all("h2")]
    assert (
        heads.index("What was left out")
        < heads.index("Check recordings, before and after")
        < heads.index("The catalogue against the misfit")
    )
    for title in (
        "Where simulation and recordings differ",
        "Fitted recordings, before and after",
        "Parameter shifts",
        "Placebo",
    ):
        assert title in heads
    assert "+29\u00a0%" in page and "300" in page and "50" in page  # R_eddy was 80 where 62 is right; rms in nm
    group = (folders["group"] / "report.html").read_text(encoding="utf-8")
    assert "Next experiment" in group and "the coil current by a shunt" in group and "most likely first" in group
    apart = " from ".join(n.replace("_", " ") for n in diagnoses["group"].groups[0])
    assert f"separates {apart}" in group  # no underscores in what people read
    (size,) = map(size_of, diagnoses["group"].rivals.values())
    assert size.startswith("tau = ") and kept_together(size) in group  # what a rival would be


def test_a_misfit_that_is_no_number_is_never_a_verdict(folders, tmp_path):
    found = json.loads((folders["nothing_missing"] / "diagnosis.json").read_text())
    found["base"]["chi2_per_sample"] = float("nan")
    (tmp_path / "diagnosis.json").write_text(json.dumps(found))
    page = rebuild(tmp_path).read_text(encoding="utf-8")
    assert 'class="banner bad"' in page and "broke down" in page and "Nothing is missing" not in page


def test_a_file_that_cannot_be_used_is_shown_and_the_others_are_told(tmp_path, runs, bench):
    from fitting.diagnosis import unusable

    paths = [tmp_path / f"rec_{k}.csv" for k in range(3)]
    for k, (path, run) in enumerate(zip(paths, runs[0], strict=True)):
        y = run.channels["displacement"]
        y = np.minimum(y, np.quantile(y, 0.8)) if k < 2 else y
        rows = np.stack([np.arange(len(y)) * run.dt, run.channels["current"], y], 1)
        np.savetxt(path, rows, delimiter=",", header="time_s,current_A,displacement_m", comments="")
    sound, errors = load_sound(paths, bench)
    assert [r.name for r in sound] == ["rec_2.csv"] and len(errors) == 2
    found = unusable(errors, sound)
    assert found.message.endswith("The other recording can be read and is not clipped.") and found.data_problem == str(errors[0])
    write_diagnosis(tmp_path, found, sound, found.as_dict(), "magjax diagnose", bench=bench, shown=errors[0].shown)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert (
        "rec_0.csv and rec_1.csv must be mended first" in page and "Bench aa-050h; no fit was tried." in page and " µm for " in page
    )
    assert page.count("<svg") == 2 and "The signal at fault" in page
    table = page.split("Recordings that can be read</caption>")[1].split("</table>")[0]
    assert ">rec_2.csv<" in table and '<td class="n">250\u00a0Hz</td>' in table and "rec_0" not in table
    marked = store.load(tmp_path)["offender"]
    first, length = errors[0].shown["first"], errors[0].shown["length"]
    assert marked["span"] == pytest.approx(np.array([first, first + length - 1]) * runs[0][0].dt, rel=1e-5)


@pytest.mark.parametrize(
    ("problem", "fault"),
    [
        ("r.csv: the reading drifts by 3 through the record; let it warm up", "r.csv"),
        ("my rod.csv: the reading drifts by 3 through the record. b.2.csv: it is clipped", "my rod.csv and b.2.csv"),
        ("the drive reaches 3.2: out of the plane", "The recordings"),
        ("the periods do not repeat: in most recordings the last differs", "The recordings"),
        (
            "the reading falls where the drive rises: the sign of a channel is swapped; set scale = -1 in [columns]",
            "The bench file",
        ),
        ("r.csv: no time column among a, b; name one time_s or map it in [columns.time]", "The recordings or the bench file"),
    ],
)
def test_a_data_problem_says_what_is_at_fault(problem, fault):
    found = {"verdict": "data_problem", "message": f"{problem}.", "data_problem": problem}
    assert headline(found) == f"{fault} must be mended first; no physics is judged"


def test_check_recordings_of_a_fit_are_drawn(folders):
    page = (folders["fit"] / "report.html").read_text(encoding="utf-8")
    assert page.count("check_150Hz.csv") >= 2 and 'aria-label="Check recordings"' in page
    drawn = page.split('aria-label="Check recordings"')[1].split("</svg>")[0]
    assert ">predicted</text>" in drawn and ">before</text>" not in drawn and "before and after" not in page


def test_a_learned_function_has_a_panel_for_each_value_of_its_second_variable():
    line = {"value": [0.0, 2e-7], "low": [-1e-7, 1e-7], "high": [1e-7, 3e-7]}
    unknown = {
        "block": "magnetostriction", "variables": ["magnetization", "field"], "variable_units": ["A/m", "A/m"], "unit": "m", "seen": [[1e5, 5e5]],
        "function": {"x": [1e5, 5e5], "slices": [{"at": a, **line} for a in (5230.0, 13800.0)]},
    }  # fmt: skip
    svg = learned_function(unknown).svg
    assert (
        ">field 5.23 kA/m</text>" in svg
        and ">field 13.8 kA/m</text>" in svg
        and ">added at the magnetostriction / µm</text>" in svg
    )
    assert svg.count(">magnetization / (kA/m)</text>") == 2
    unknown |= {"variables": ["reading", "times_reading_direction"], "variable_units": ["m", "1"]}
    unknown["function"]["slices"] = [{"at": a, **line} for a in (-1.0, 1.0)]
    svg = learned_function(unknown).svg
    assert ">reading falling</text>" in svg and ">reading rising</text>" in svg


def test_what_says_nothing_is_not_drawn_and_columns_go_by_frequency(folders, tmp_path):
    fit = json.loads((folders["fit"] / "fit.json").read_text())
    assert 'aria-label="Convergence"' in (folders["fit"] / "report.html").read_text(encoding="utf-8")
    shutil.copy(folders["fit"] / "report.npz", tmp_path)
    (tmp_path / "fit.json").write_text(json.dumps(fit | {"history": fit["history"][:2]}))
    assert 'aria-label="Convergence"' not in rebuild(tmp_path).read_text(encoding="utf-8")
    evidence = store.load(tmp_path)
    evidence["inside"] = dict(reversed(evidence["inside"].items()))
    titles = re.findall(r">rec[^<]*, (\d+) Hz</text>", inside(evidence, "current").svg)
    assert len(titles) == 3 and titles == sorted(titles, key=int)


def test_the_band_of_a_strip_has_no_teeth(folders):
    evidence = store.load(folders["fit"])
    (loop,) = (evidence["loops"][k] for k in ("0",))
    loop["noise"] = np.where(np.arange(len(loop["noise"])) % 2, 1.0, 1.4) * loop["noise"]
    smooth = {**loop, "noise": np.full_like(loop["noise"], np.median(loop["noise"]))}
    drawn = [loops({**evidence, "loops": {"0": one}, "chosen": [0]}, "displacement", "current").svg for one in (loop, smooth)]
    assert drawn[0] == drawn[1]


def test_the_placebo_panel():
    counted = {"runs": 20, "false_alarms": 1, "named": {"creep": 1}, "highest_z": [3.0, 6.1]}
    text = json.dumps(placebo_section({"procedure": "search", "screening_alarms": 2, **counted}, "attributed"))
    assert "In 1 of 20 sets" in text and "search adopted an effect" in text and "In 2 of them something scored" in text
    assert "creep: 1" in text and "(5 %; 95 % interval < 1 % to 24 %)" in text
    older = json.dumps(placebo_section(counted, "attributed"))  # a folder of before: no rivals were fitted
    assert "Only the screening was repeated" in older and "search adopted" not in older
    assert "Not tried" in json.dumps(placebo_section(None, "attributed"))
    assert placebo_section(None, "data_problem") is None
    low, high = interval(0, 20)
    assert low == 0 and high == pytest.approx(0.161, abs=2e-3)  # Wilson: z^2 / (n + z^2)


def test_chi2_is_defined_and_a_diagnosis_does_not_ask_for_itself(folders, html, kind):
    assert html.count("It is 1 where only noise is left") == (kind not in ("unsettled", "unreadable"))
    if kind in ("fit", "poor"):
        return
    found = json.loads((folders[kind] / "diagnosis.json").read_text())
    for fit in filter(None, (found["base"], found["repaired"])):
        fit["message"] = "what repeats is 3.7 times its noise; run magjax diagnose on the same files"
    text = json.dumps(diagnosis_page(found, store.load(folders[kind]))["sections"], default=str)
    assert "same files" not in text and ("3.7 times its noise" in text) == (kind not in ("data_problem", "unsettled", "unreadable"))


def test_what_repeats_stands_beside_what_a_sample_leaves(folders):
    evidence = store.load(folders["fit"])
    misfit, noise = repeating(evidence)
    loop = evidence["loops"]["0"]  # the same from one period of the model less the mean of the periods, which holds its noise too
    assert 0.3 * noise[0] < misfit[0] < np.sqrt(np.mean((loop["model"] - loop["measured"]) ** 2))
    assert strokes(evidence)[0] == pytest.approx(np.ptp(loop["measured"]), rel=0.02)
    older = {k: v for k, v in evidence.items() if k != "stroke"}
    assert strokes(older)[0] == pytest.approx(np.ptp(loop["measured"]))
    fit = json.loads((folders["fit"] / "fit.json").read_text())
    row = dict(zip((made := recordings_table(fit, evidence))["head"], made["rows"][0], strict=True))
    shown = [row[k].split()[0] for k in ("repeating misfit", "its noise", "of the stroke")]
    expected = 1e9 * misfit[0], 1e9 * noise[0], 100 * misfit[0] / strokes(evidence)[0]
    assert [float(v) for v in shown] == pytest.approx(expected, rel=0.02)
    assert "repeating misfit" not in recordings_table(fit)["head"]  # where the evidence was lost


def test_before_and_after_stand_in_one_table(folders):
    page = (folders["attributed"] / "report.html").read_text(encoding="utf-8")
    found = json.loads((folders["attributed"] / "diagnosis.json").read_text())
    table = page.split("Misfit of each recording, before and after</caption>")[1].split("</table>")[0]
    ends = [f"{found[k]['recordings'][0]['chi2_per_sample']:.2f}" for k in ("base", "repaired")]
    assert f'<td class="n">{ends[0]}</td><td class="n">{ends[1]}</td>' in table and table.count("<tr>") == 4
    assert "Misfit of each recording, before" not in (folders["nothing_missing"] / "report.html").read_text(encoding="utf-8")
    assert (
        "noise of what repeats, in all harmonics" in page
        and ">noise of what repeats</text>" in page
        and ">noise of a sample</text>" in page
    )


def test_a_size_found_beside_a_misfit_is_doubted_like_the_later_table(diagnoses, folders):
    found = json.loads((folders["attributed"] / "diagnosis.json").read_text())
    assert "size (± too narrow)" not in (folders["attributed"] / "report.html").read_text(encoding="utf-8")
    found["repaired"]["chi2_per_sample"] = 1.4
    page = json.dumps(diagnosis_page(found, {})["sections"], default=str, ensure_ascii=False)
    assert "size (± too narrow)" in page and "std. error (too narrow)" in page


def test_messages_read_as_sentences():
    assert sentence("rec_1.csv: it drifts") == "rec_1.csv: it drifts."
    assert (
        sentence("excess loss: chi2/N falls. check: 48.1 -> 46 nm; 1.5 um")
        == "Excess loss: χ²/N falls. check: 48.1 → 46 nm; 1.5 µm."
    )
    assert sentence("") == ""


def unknown_page(folders, tmp_path, boundaries):
    """The page of an `unknown_at` with a learned function, among these boundaries."""
    found = json.loads((folders["unknown_at"] / "diagnosis.json").read_text())
    line = {"at": None, "value": [0.0, 2e-7], "low": [-1e-7, 1e-7], "high": [1e-7, 3e-7]}
    found["unknown"] |= {
        "block": "sensor", "variables": ["reading"], "variable_units": ["m"], "unit": "m", "share": 0.9, "seen": [[0.0, 1e-6]], "rms": 1e-7,
        "left_out": [30.0, 13.0], "bends_over": 0.1, "turns_within": 1.5e-8, "function": {"x": [0.0, 1e-6], "slices": [line]}, "boundaries": boundaries,
        "rivals": [{"block": "coil", "variables": ["field"]}],
    }  # fmt: skip
    found["repaired"] = found["base"]
    (tmp_path / "diagnosis.json").write_text(json.dumps(found))
    shutil.copy(folders["unknown_at"] / "report.npz", tmp_path)
    return rebuild(tmp_path).read_text(encoding="utf-8")


def test_an_unknown_says_which_boundaries_were_tried_and_why_one_is_framed(folders, tmp_path):
    def boundary(block, variables, chi2, left_out):
        return {"block": block, "variables": variables, "evidence": 400.0, "share": 0.6, "visibility": 0.4, "chi2_per_sample": chi2, "left_out": left_out}  # fmt: skip

    rows = [
        boundary("mechanics", ["stretch"], 1.4, 19.0),
        boundary("sensor", ["reading"], 1.19, 13.0),
        boundary("source", ["current"], None, None),
        boundary("coil", ["field"], 1.2, 13.5),
    ]
    page = unknown_page(folders, tmp_path, rows)
    assert re.search(r"comes round within</th><td>0.015\sµm</td>", page)
    table = page.split("Where a smooth function would serve</caption>")[1].split("</table>")[0]
    said = [re.findall(r"<t[hd][^>]*>([^<]*)</t[hd]>", row) for row in table.split("<tr>")[2:]]
    assert [row[-3:] for row in said] == [
        ["1.40", "19.0", "tried, worse"],
        ["1.19", "13.0", "kept"],
        ["–", "–", "not tried"],
        ["1.20", "13.5", "not told from it"],
    ]
    assert "need not be the darkest" in page and ">The model with the learned function<" in page
    older = unknown_page(
        folders, tmp_path, [{k: b[k] for k in ("block", "variables", "evidence", "share", "visibility")} for b in rows]
    )
    assert "not tried" not in older and "left out: χ²/N" not in older  # a folder of before does not say


def test_what_alternates_from_period_to_period_is_told_in_words(folders, tmp_path):
    """Its table had said amplitude, stderr, share and rms as they stand in diagnosis.json, without units."""
    found = json.loads((folders["unknown_at"] / "diagnosis.json").read_text())
    found["unknown"] = {
        "block": "mechanics", "region": "every second period", "explained_share": 0.0, "amplitude": -0.01618, "stderr": 3.2e-5, "share": 0.53,
        "rms": 1.22e-6, "unit": "m",
    }  # fmt: skip
    (tmp_path / "diagnosis.json").write_text(json.dumps(found))
    shutil.copy(folders["unknown_at"] / "report.npz", tmp_path)
    table = rebuild(tmp_path).read_text(encoding="utf-8").split("The unknown</caption>")[1].split("</table>")[0]
    said = dict(re.findall(r"<t[hd][^>]*>([^<]*)</t[hd]>", row.replace("\xa0", " ")) for row in table.split("<tr>")[2:])
    assert said["size, of the motion"] == "1.62 ± 0.0032 %" and said["rms of what alternates"] == "1.22 um"
    assert said["share of it that goes with the motion"] == "53 %" and len(said) == 5


def test_a_block_is_shaded_by_its_share_of_what_is_above_the_noise(poor, fitted, runs):
    excess = (poor.chi2_per_sample - 1) * poor.data_count
    half, all_of_it = (Candidate("x", block, 9.0, 0.5, 0.1, {}, drop, 0.1, False) for block, drop in (("coil", 0.5 * excess), ("sensor", 9 * excess)))  # fmt: skip
    assert where(poor, [all_of_it, half], runs[0], "displacement")["by_block"] == pytest.approx({"sensor": 1.0, "coil": 0.5})
    weak = dataclasses.replace(half, predicted_chi2_drop=3.0)  # where only noise is left its own scatter is what it is measured by
    assert where(fitted, [weak], runs[0], "displacement")["by_block"]["coil"] < 0.2


def test_where_the_noise_is_met_no_block_has_a_share_of_what_is_above_it(folders, tmp_path):
    shutil.copy(folders["nothing_missing"] / "report.npz", tmp_path)
    stored = json.loads((folders["nothing_missing"] / "diagnosis.json").read_text())
    stored["where"]["by_block"] = {"coil": 0.97}
    for chi2, shared in ((0.99, False), (1.31, True)):
        stored["base"]["chi2_per_sample"] = chi2
        (tmp_path / "diagnosis.json").write_text(json.dumps(stored))
        page = rebuild(tmp_path).read_text(encoding="utf-8")
        assert ("coil 97 %" in page) is shared and ("nothing is above it that a block could have a share of" in page) is not shared


def test_many_recordings_stay_below_a_megabyte(folders, tmp_path):
    """Twelve drawn of forty, each with noise of its own, before and after, and twelve check recordings."""
    found = json.loads((folders["attributed"] / "diagnosis.json").read_text())
    evidence = store.load(folders["attributed"])
    rng = np.random.default_rng(0)
    for key in ("base", "repaired"):
        part = evidence[key]
        for name in ("name", "frequency", "periods", "noise", "chi2", "rms"):
            part[name] = np.tile(part[name], 14)[:40]
        part["chosen"] = np.arange(12)
        for which in ("loops", "trace"):
            old = part[which]
            part[which] = {str(k): dict(old[str(k % 3)]) for k in range(12)}
        for loop in part["loops"].values():
            loop["model"] = loop["model"] + 1e-7 * rng.standard_normal(len(loop["model"]))
        for which in ("measured", "misfit", "floor"):
            part["lines"][which] = np.tile(part["lines"][which], (14, 1))[:40]
    evidence["checks"] = {str(k): evidence["checks"]["0"] for k in range(12)}
    found["check"] = found["check"] * 12
    (tmp_path / "diagnosis.json").write_text(json.dumps(found))
    store.save(tmp_path, evidence)
    assert rebuild(tmp_path).stat().st_size < 1_000_000


@pytest.mark.parametrize("name", ["fit", "attributed"])
def test_the_page_of_an_earlier_result_does_not_outlive_its_numbers(tmp_path, monkeypatch, folders, fitted, diagnoses, runs, name):
    """Ctrl-C between the numbers and the page left the page of the result before."""
    from fitting.report import evidence

    shutil.copytree(folders[name], tmp_path / "again")

    def stopped(*a, **k):
        raise KeyboardInterrupt

    monkeypatch.setattr(evidence, "of_fit", stopped)
    with pytest.raises(KeyboardInterrupt):
        if name == "fit":
            write_fit(tmp_path / "again", fitted, runs[0], fitted.as_dict(), "")
        else:
            found = diagnoses[name]
            write_diagnosis(tmp_path / "again", found, runs[0], found.as_dict(), "")
    left = {p.name for p in (tmp_path / "again").iterdir()}
    assert not left & {"report.html", "report.npz"} and left & {"fit.json", "diagnosis.json"}
