"""The arena's report: its statistics against closed forms and brute force, and that nothing is dropped or mixed."""

import json
import re
import shlex
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("pyarrow")
pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")
pytest.importorskip("mujoco")

import pyarrow as pa
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text
from scipy.stats import binom, binomtest

from qpavoid.errors import ConfigError
from qpavoid_bench.arena import statistics
from qpavoid_bench.arena.coverage import missing_results
from qpavoid_bench.arena.figures import safety_against_tracking, success_against_time
from qpavoid_bench.arena.report import report_of, rerun_line, write_report
from qpavoid_bench.arena.results import results_of
from qpavoid_bench.arena.scores import COLUMNS
from qpavoid_bench.arena.statistics import CONFIDENCE, duel, mean, median, pareto, ranks, rate
from qpavoid_bench.arena.store import Store, read_failures
from qpavoid_bench.arena.tables import COLUMNS as SHOWN
from qpavoid_bench.arena.tables import MORE

flags = st.lists(st.booleans(), min_size=1, max_size=30)


def row(entrant="qp", case="a", family="field", success=True, **more):
    """A run, of which only what matters is given."""
    blank = {"str": "", "int": 1, "float": 0.01, "bool": False}
    given = {"entrant": entrant, "case": case, "family": family, "success": success, "settings": f"of {entrant}"}
    return {
        **{name: blank[kind] for name, kind in COLUMNS.items()},
        "robot": "panda",
        "reachable": True,
        "seed": int.from_bytes(case.encode()[-6:], "big"),  # another case, another seed
        **given,
        **more,
    }


def table(rows):
    return pa.Table.from_pylist(rows)


def grid(entrants, cases=12, seed=0, **more):
    """Every entrant in every case, the later ones succeeding more often."""
    draw = np.random.default_rng(seed)
    rows = []
    for i, entrant in enumerate(entrants):
        for k in range(cases):
            won = bool(draw.random() < (i + 1) / len(entrants))
            error, distance = 0.1 * draw.random(2)
            own = {"success": won, "collided": not won, "min_distance": distance if won else -distance}
            rows.append(row(entrant, f"case {k}", f"field {k % 2}", seed=k, tracking_error=error, **own, **more))
    return rows


def sections(rows, facts=None):
    return {section.title: section for section in report_of(table(rows), facts or {})}


def texts(section):
    """The tables of a section as text."""
    return [[[cell.text for cell in cells] for cells in t.rows] for t in section.tables]


# --- statistics -----------------------------------------------------------------------------------------------------


@given(st.integers(0, 60), st.integers(1, 60))
def test_a_rate_has_wilsons_interval(won, trials):
    won = min(won, trials)
    expected = binomtest(won, trials).proportion_ci(CONFIDENCE, method="wilson")
    assert rate(won, trials) == pytest.approx((won / trials, expected.low, expected.high), abs=1e-12)


def test_a_rate_as_in_print():
    """Newcombe, Statistics in Medicine 17 (1998), table I, method 3."""
    printed = {
        (81, 263): (0.2553, 0.3662),
        (15, 148): (0.0624, 0.1605),
        (0, 20): (0.0, 0.1611),
        (1, 29): (0.0061, 0.1718),
    }
    for (won, trials), limits in printed.items():
        assert rate(won, trials)[1:] == pytest.approx(limits, abs=6e-5)


@pytest.mark.parametrize("estimate", [mean, median])
def test_estimates_of_nothing_are_nan(estimate):
    """Nothing gives no estimate."""
    with pytest.raises(ValueError, match="no values"):
        estimate(np.zeros(0))
    with pytest.raises(ValueError, match="no trials"):
        rate(0, 0)


@pytest.mark.parametrize("count", [6, 20, 60])
@pytest.mark.parametrize(("estimate", "truth"), [(mean, 1.0), (median, np.log(2.0))])
def test_mean_interval_coverage_of_exponential_values(estimate, truth, count):
    """Intervals of exponential values hold the truth about as often as they say."""
    draw = np.random.default_rng(count)
    held = [low <= truth <= high for _, low, high in (estimate(draw.exponential(size=count)) for _ in range(400))]
    least = 0.93 if estimate is median else 0.85  # the skew costs the mean of few something
    assert least <= np.mean(held) <= 0.995


def test_mean_interval_width():
    """The interval of a mean is as wide as students for few normal values and as the normal one for many."""
    draw = np.random.default_rng(1)
    few, many = draw.normal(size=(300, 8)), draw.normal(size=statistics._MANY)
    held = np.mean([low <= 0.0 <= high for _, low, high in map(mean, few)])
    assert 0.92 <= held <= 0.98  # plain percentiles hold 0.89
    fewer = many[: statistics._MANY - 1]
    assert mean(fewer)[1:] == pytest.approx(mean(many)[1:], abs=0.004)


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=40))
def test_estimates_lie_within_their_intervals(values):
    """Estimates lie within their intervals and these within the values."""
    values = np.array(values)
    for estimate in (mean, median):
        middle, low, high = estimate(values)
        assert values.min() - 1e-9 <= low <= middle <= high <= values.max() + 1e-9
        assert estimate(values) == (middle, low, high)


@pytest.mark.parametrize("count", [6, 11, 40, 101])
def test_the_interval_of_a_median_is_the_narrowest_that_the_sign_test_allows(count):
    low = int(median(np.arange(count, dtype=float)).low)
    outside_interval = 2.0 * binom.cdf(low, count, 0.5)
    assert outside_interval <= 1.0 - CONFIDENCE < 2.0 * binom.cdf(low + 1, count, 0.5)
    assert median(np.arange(count, dtype=float)).high == count - 1 - low


@given(flags, st.randoms())
def test_duel_equals_binomial_test(first, random):
    """A duel is fair and that of the binomial test."""
    second = np.array([random.random() < 0.5 for _ in first])
    first = np.array(first)
    there, back = duel(first, second), duel(second, first)
    assert (there.only_first, there.only_second, there.p) == (back.only_second, back.only_first, back.p)
    apart = there.only_first + there.only_second
    assert there.p == pytest.approx(binomtest(there.only_first, apart).pvalue if apart else 1.0)
    assert not duel(first, first).decided


def test_ranks_are_shared_without_significant_difference():
    success, names = np.zeros((20, 5), dtype=bool), ["never", "always", "nearly", "half", "less than half"]
    for i, won in enumerate((0, 20, 17, 10, 9)):
        success[:won, i] = True
    found = ranks(success, np.zeros((20, 5)), names)
    assert list(found) == ["always", "nearly", "half", "less than half", "never"]
    assert list(found.values()) == [1, 1, 3, 3, 5]  # 3 of 20 apart: p = 0.25; 10 apart: p = 0.002


def test_ranks_order_equal_success_by_tracking():
    """Equal success is put in order by tracking but shares the rank."""
    error = np.tile([0.03, 0.01, 0.02], (9, 1))
    assert list(ranks(np.ones((9, 3), dtype=bool), error, ["a", "b", "c"]).items()) == [("b", 1), ("c", 1), ("a", 1)]


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=15))
def test_pareto_front_equals_brute_force(points):
    x, y = np.array(points, dtype=float).T
    beaten = [
        any((a <= c and b >= d) and (a < c or b > d) for a, b in zip(x, y, strict=True))
        for c, d in zip(x, y, strict=True)
    ]
    assert pareto(x, y).tolist() == [not b for b in beaten]


# --- nothing is dropped, nothing is mixed ---------------------------------------------------------------------------


@given(st.randoms(use_true_random=False))
def test_results_are_independent_of_row_order(random):
    """The order of rows changes nothing."""
    rows = grid(["c", "a", "b"])
    expected = results_of(table(rows))
    random.shuffle(rows)
    found = results_of(table(rows))
    assert found.entrants == expected.entrants and found.families == expected.families
    assert found.ranking() == expected.ranking()
    for family in (None, 0, 1):
        for column in ("tracking_error", "min_distance"):
            assert np.array_equal(
                np.sort(found.table(column, family), axis=0), np.sort(expected.table(column, family), axis=0)
            )


def test_results_cell_matches_case_and_entrant():
    """Every cell is that of its case and entrant."""
    rows = grid(["a", "b", "c"], cases=5)
    found = results_of(table(rows), ["c"])
    assert found.entrants == ("c", "a", "b")
    cells = {(r["entrant"], r["case"]): r["tracking_error"] for r in rows}
    cases = sorted({r["case"] for r in rows})
    expected = [[cells[entrant, case] for entrant in found.entrants] for case in cases]
    assert found.table("tracking_error").tolist() == expected
    assert [rows[0]["family"], rows[1]["family"]] == [found.families[i] for i in found.family[:2]]


def test_results_count_duplicates_once():
    rows = grid(["a", "b"])
    once, twice = results_of(table(rows)), results_of(table(rows + rows[5:9]))
    assert twice.replaced == 4 and once.replaced == 0
    assert twice.ranking() == once.ranking()
    assert np.array_equal(twice.table("tracking_error"), once.table("tracking_error"))


@pytest.mark.parametrize("changed", [{"settings": "new"}, {"version": "2"}])
def test_results_do_not_mix_settings_and_versions(changed):
    """Settings and versions of an entrant are never mixed."""
    rows = grid(["a", "b"], cases=4)
    anew = [{**r, **changed, "tracking_error": 1.0} for r in rows if r["entrant"] == "a"][:3]
    found = results_of(table(rows + anew))
    assert found.replaced == 4  # the fourth case, too: it was run by another a
    assert list(found.missing()) == [("a", "field 1", 1)]
    assert found.values("tracking_error", 0).tolist() == [1.0, 1.0, 1.0]
    assert len(found.values("tracking_error", 1)) == 3


def test_results_missing_cell_excludes_its_case():
    rows = grid(["a", "b"])
    gone = next(r for r in rows if r["entrant"] == "b" and r["family"] == "field 1")
    rows.remove(gone)
    found = sections(rows)
    points = found["What this was made on"].points
    assert any(point == "b has not run 1 cases of field 1, which count for no entrant." for point in points)
    assert any("11 cases that every entrant has run" in point for point in points)
    assert "5 cases, on panda." in found["Family: field 1"].text
    left = np.mean([r["success"] for r in rows if r["entrant"] == "a" and r["case"] != gone["case"]])
    shown = {cells[1]: cells[2] for cells in texts(found["Overall"])[0]}
    assert shown["a"] == f"{100 * left:.0f}"


def test_every_run_is_counted_in_the_rates_of_its_family():
    rows = grid(["a", "b", "c"], cases=30)
    found = sections(rows)
    for family in ("field 0", "field 1"):
        for cells in texts(found[f"Family: {family}"])[0]:
            own = [r["success"] for r in rows if r["entrant"] == cells[1] and r["family"] == family]
            assert len(own) == 15 and cells[2] == f"{100 * np.mean(own):.0f}"


def test_results_replace_non_finite_figures_by_the_worst():
    """Figures that are no numbers stand at the worst."""
    rows = grid(["a", "b"], cases=4)
    worst = {name: max(r[name] for r in rows) for name in ("tracking_error", "jerk")}
    deepest = min(r["min_distance"] for r in rows)
    rows[0] |= {"tracking_error": float("nan"), "jerk": float("inf"), "min_distance": float("nan")}
    rows[1] |= {"min_distance": float("inf")}  # nothing to touch: a figure as good as any
    found = results_of(table(rows))
    assert found.bounded == 3
    assert found.row(0)["tracking_error"] == worst["tracking_error"] and found.row(0)["jerk"] == worst["jerk"]
    assert found.row(0)["min_distance"] <= deepest and found.row(1)["min_distance"] == np.inf
    for section in report_of(table(rows), {}):
        assert "nan" not in str(texts(section))


def test_report_without_common_case_names_remedy(tmp_path):
    """No runs and no common case say what to do."""
    with pytest.raises(ConfigError, match="no runs to report; `qpavoid bench run` makes some"):
        list(report_of(table([row()]).slice(0, 0), {}))
    with pytest.raises(ConfigError, match="no case was run by all of a, b, b has run the fewest"):
        list(report_of(table([row("a", "1"), row("a", "2"), row("b", "3")]), {}))
    with pytest.raises(ConfigError, match="no results here"):
        write_report(tmp_path)


def test_one_run_makes_a_report():
    found = sections([row()])
    assert texts(found["Overall"])[0][0][:3] == ["1", "qp", "100"]
    assert not found["Beside the best"].tables and found["Worst runs"].text == ("None.",)


# --- what is written ------------------------------------------------------------------------------------------------

NASTY = "<b>a|b</b> $x$ & `c` __d__"


class Page(HTMLParser):
    """Checks that elements nest, and keeps what matters of them."""

    VOID = ("meta", "br", "img", "link", "hr")

    def __init__(self, text):
        super().__init__()
        self.open, self.elements, self.cells = [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "td":
            self.cells.append("")

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "td" in self.open:
            self.cells[-1] += data


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A folder with a report on entrants and failures that a page may stumble over."""
    folder = tmp_path_factory.mktemp("a folder")
    rows = grid(["qp", NASTY, "$y", "tracking"], failure=f"ValueError: {NASTY}\nsecond line", failed=0.5)
    with Store(folder) as store:
        for one in rows:
            store.runs.append(one)
        store.fail({"family": "field 0", "seed": 99, "entrant": None, "failure": NASTY})
        entrants = {f"of {NASTY}": {"name": NASTY, "says": NASTY, "settings": {"solver": NASTY}}}
        facts = {"title": NASTY, "machine": {"cpu": NASTY}, "versions": {"numpy": "2"}, "absent": {"placo": ["placo"]}}
        store.describe({**facts, "entrants": entrants})
    return folder, write_report(folder)


def test_the_report_is_markdown_with_its_pictures_and_one_page(written):
    folder, files = written
    assert {file.suffix for file in files} == {".md", ".png", ".html"} and all(f.stat().st_size > 1000 for f in files)
    markdown = (folder / "report.md").read_text()
    assert sorted(re.findall(r"!\[.*?\]\((.*?)\)", markdown)) == sorted(f.name for f in files if f.suffix == ".png")
    order = [
        "What this was made on",
        "Limits",
        "Who takes part",
        "How it is scored",
        "Overall",
        "Family: ",
        "Worst",
        "Failures",
    ]
    places = [markdown.index(f"\n## {title}") for title in order]
    assert places == sorted(places)


def test_report_page_is_self_contained(written):
    """The page nests needs no network and carries what it is sorted by."""
    folder, _ = written
    text = (folder / "report.html").read_text()
    page = Page(text)
    references = [
        value
        for _, attributes in page.elements
        for name, value in attributes.items()
        if name in ("src", "href", "xlink:href")
    ]
    assert references and all(reference.startswith(("#", "data:")) for reference in references)
    assert not re.search(r"@import|url\((?!#)", text)
    assert sum(tag == "svg" for tag, _ in page.elements) == 3 and sum(tag == "script" for tag, _ in page.elements) == 1
    cells = [attributes for tag, attributes in page.elements if tag == "td"]
    assert len(cells) > 100
    for cell in cells:
        assert cell.get("class") == "text" or np.isfinite(float(cell["data-sort"]))


def test_report_escapes_names_and_failures(written):
    """Whatever names and failures hold is shown as it is."""
    folder, _ = written
    page = Page((folder / "report.html").read_text())
    assert not any(tag == "b" and attributes for tag, attributes in page.elements)
    assert NASTY in page.cells and f"ValueError: {NASTY}\nsecond line" in page.cells
    markdown = (folder / "report.md").read_text()
    escaped = r"\<b\>a\|b\</b\> $x$ & \`c\` \_\_d\_\_"
    assert f"| {escaped} |" in markdown and f"ValueError: {escaped} second line |" in markdown


def test_tables_of_the_markdown_are_well_formed(written):
    folder, _ = written
    lines = (folder / "report.md").read_text().splitlines()
    tables = 0
    for i, line in enumerate(lines):
        if not line.startswith("|"):
            continue
        count = len(re.findall(r"(?<!\\)\|", line))
        if not lines[i - 1].startswith("|"):
            tables += 1
            assert lines[i - 1] == "" and lines[i + 1].count("---") == count - 1
            expected = count
        assert line.endswith(" |") and count == expected
    assert tables == 2 + 2 + 1 + 2 * 2 + 1 + 1  # who, how; overall; beside; two families; worst; failures


def test_report_names_absent_entrants_and_failures(written):
    markdown = (written[0] / "report.md").read_text()
    assert "placo does not take part: it needs placo." in markdown
    assert f"- field 0, seed 99: could not be made: `{NASTY.replace('`', chr(39))}`\n" in markdown


def test_report_is_deterministic(written, tmp_path):
    """The same results make the same report."""
    folder, files = written
    before = {file: file.read_bytes() for file in files}
    write_report(folder)
    assert {file: file.read_bytes() for file in files} == before


def test_report_order_of_worst_runs():
    """The worst runs are the deepest then those that stop shortest."""
    runs = [
        row(case="1", seed=1, success=False, collided=True, min_distance=-0.002, contacts=1),
        row(case="2", seed=2, success=False, final_error=0.5),
        row(case="3", seed=3, success=False, final_error=0.1, stuck=True),
        row(case="4", seed=4, success=False, collided=True, min_distance=-0.03, contacts=2),
        row(case="5", seed=5),
    ]
    (rows,) = texts(sections(runs)["Worst runs"])
    assert [cells[2] for cells in rows] == ["4", "1", "2"]
    assert [cells[4] for cells in rows] == [
        "2 contacts, 30.0 mm deep",
        "1 contacts, 2.0 mm deep",
        "500 mm short of its goal",
    ]


def test_rerun_line_is_a_command(cli, tmp_path):
    """The line that runs one again is a command."""
    run = row("my law", family="situation1", seed=7)
    line = rerun_line(run, tmp_path / "a folder")
    assert line == f"qpavoid bench show '{tmp_path / 'a folder'}' --family situation1 --seed 7 --entrant 'my law'"
    shown = cli("bench", "show", "--help").stdout
    assert all(option in shown for option in ("--family", "--seed", "--entrant"))


def test_report_counts_failures():
    """Failures are counted with what they said."""
    runs = [row(case=str(k), failure="" if k < 2 else f"said {k % 2}" if k < 7 else "said 0") for k in range(9)]
    (rows,) = texts(sections(runs)["Failures"])
    assert rows == [["qp", "5", "said 0"], ["qp", "2", "said 1"]]


def test_report_units():
    """A column's scale is that from the unit of the score to the unit of its heading."""
    score_units = {"[mm]": ("[m]", 1e3), "[%]": ("", 100.0), "[µs]": ("[µs]", 1.0)}
    for column in (*SHOWN, *MORE):
        unit = re.search(r"\[.*\]", column.heading)[0]
        assert column.name in COLUMNS
        assert column.scale == score_units.get(unit, (unit, 1.0))[1], column.heading


def test_the_command_writes_the_report(cli, written):
    folder, files = written
    done = cli("bench", "report", folder)
    assert done.status == 0 and done.stdout.split("\n")[:-1] == [str(file) for file in files]
    assert cli("bench", "report", folder / "nowhere").status == 2
    assert json.loads((folder / "suite.json").read_text())["title"] == NASTY


# --- what is not there ---------------------------------------------------------------------------------------


def test_results_count_changed_family_once():
    """A family that was changed does not count twice."""
    before = [row(name, f"before {k}", seed=k, success=name == "qp") for k in range(3) for name in ("qp", "eq10")]
    after = [row(name, f"after {k}", seed=k, success=name == "eq10") for k in range(2) for name in ("qp", "eq10")]
    results = results_of(table([*before, *after]), ("qp", "eq10"))
    assert results.table("success").sum(axis=0).tolist() == [1, 2]  # the third seed is as it was
    assert results.replaced == 4 and len(results.cell) == 3
    one_alone = results_of(table([*before, *after[:1]]), ("qp", "eq10"))  # then there is nothing to compare it with
    assert list(one_alone.missing()) == [("eq10", "field", 1)] and one_alone.replaced == 2


def test_report_names_missing_cases():
    results = results_of(table([row(name, str(k), seed=k) for k in (3, 4, 7) for name in ("qp", "pink")]))
    entrants = {name: {"name": name, "says": "", "settings": {}} for name in ("qp", "hqp")}
    facts = {"families": ["field", "shelf"], "first_seed": 3, "seeds": 4, "entrants": entrants}
    facts["absent"] = {"pink": ["pin-pink"], "mink": ["mink"]}  # pink has run here before
    facts["failures"] = [
        {"family": "shelf", "seed": k, "entrant": who, "failure": "no\nway"} for who in (None, "hqp") for k in range(7)
    ]
    assert list(missing_results(results, facts)) == [
        "No entrant has run 2 of the 4 cases of field that the suite asks for.",
        "No entrant has run 4 of the 4 cases of shelf that the suite asks for.",
        "mink does not take part: it needs mink.",
        "hqp was to take part, and has no run.",
        "shelf, seed 0, 1, 2, 3, 4, …: could not be made: `no way`",
        "shelf, seed 0, 1, 2, 3, 4, …: could not be run by hqp: `no way`",
    ]
    whole = {"families": ["field"], "first_seed": 3, "seeds": 2, "entrants": {"qp": entrants["qp"]}}
    assert not list(missing_results(results, whole)) and not list(missing_results(results, {}))


def test_report_names_different_versions():
    results = results_of(table([row("qp", version="2"), row("eq10", version="1")]))
    assert [line for line in missing_results(results, {}) if "different versions" in line and "eq10 1, qp 2" in line]


def test_rerun_line_of_entrant_from_file(tmp_path):
    """An entrant from a file is run again from it."""
    facts = {"entrants": {"of Mine": {"name": "Mine", "says": "", "settings": {"file": "my law.py", "digest": "0"}}}}
    runs = [row(name, success=False) for name in ("Mine", "qp")]
    worst = next(section for section in report_of(table(runs), facts, tmp_path) if section.title == "Worst runs")
    commands = {line[0].text: shlex.split(line[-1].text)[-1] for line in worst.tables[0].rows}
    assert commands == {"Mine": "my law.py:Mine", "qp": "qp"}


def test_a_folder_without_a_list_of_failures_keeps_its_facts(tmp_path):
    with Store(tmp_path) as store:
        store.runs.append(row())
        store.describe({"title": "Facts", "entrants": {}})
    (tmp_path / "failures.jsonl").write_text('{"family": "field", "se')  # a sweep is writing it
    assert read_failures(tmp_path) == []
    (tmp_path / "failures.jsonl").unlink()
    write_report(tmp_path)
    assert (tmp_path / "report.md").read_text(encoding="utf-8").startswith("# Arena: Facts\n")


@pytest.mark.parametrize("times", [(60.0, 104.0, 143.0), (20.0, 90.0, 4000.0)])
def test_an_axis_of_times_has_numbers_to_read_it_by(times):
    rows = [row(e, f"case {k}", tick_p50=t) for e, t in zip("abc", times, strict=True) for k in range(3)]
    figure = success_against_time(results_of(table(rows)))
    FigureCanvasAgg(figure).draw()
    axis = figure.axes[0].xaxis
    low, high = figure.axes[0].get_xlim()
    shown = [tick for tick in axis.get_major_ticks() if tick.label1.get_text() and low <= tick.get_loc() <= high]
    assert low < min(times) and max(times) < high and 3 <= len(shown) <= 12
    boxes = [tick.label1.get_window_extent() for tick in shown]
    assert not any(a.overlaps(b) for a, b in pairwise(boxes))


def test_lines_to_names_do_not_cross_names_out():
    """In the picture of many that are good and some that are not, lines come down steeply."""
    rows = []
    for i, entrant in enumerate(f"entrant {k}" for k in range(17)):
        rows += [row(entrant, f"case {k}", collided=k < max(0, i - 12), tracking_error=0.01 * i) for k in range(20)]
    figure = safety_against_tracking(results_of(table(rows)))
    FigureCanvasAgg(figure).draw()
    names = figure.axes[0].texts
    assert len(names) == 17
    for name in names:
        text, line = Text.get_window_extent(name), name.arrow_patch.get_window_extent()
        assert line.x1 <= text.x0 + 1.0
