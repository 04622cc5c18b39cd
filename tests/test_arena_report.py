"""The arena's report: its statistics against closed forms and brute force, and that nothing is dropped or mixed."""

import re
import shlex
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("matplotlib")
pytest.importorskip("mujoco")
pytest.importorskip("statsmodels")

from matplotlib.backends.backend_agg import FigureCanvasAgg
from scipy.stats import binomtest

from qpavoid.errors import ConfigError
from qpavoid_bench.arena.figures import success_against_time
from qpavoid_bench.arena.report import comparable_results, report_lines, rerun_line, write_report
from qpavoid_bench.arena.results import results_of
from qpavoid_bench.arena.scores import COLUMNS
from qpavoid_bench.arena.statistics import duel, mean, median, pareto, ranks, rate
from qpavoid_bench.arena.store import Store
from qpavoid_bench.arena.tables import COLUMNS as SHOWN
from qpavoid_bench.arena.tables import MORE, MOTORS

flags = st.lists(st.booleans(), min_size=1, max_size=30)


def row(entrant="qp", case="a", family="field", success=True, **more):
    """A run, of which only what matters is given."""
    blank = {"str": "", "int": 1, "float": 0.01, "bool": False}
    given = {"entrant": entrant, "case": case, "family": family, "success": success, "settings": f"of {entrant}"}
    return {
        **{name: blank[kind] for name, kind in COLUMNS.items()},
        "torque": 0.0,
        "robot": "panda",
        "reachable": True,
        "seed": int.from_bytes(case.encode()[-6:], "big"),  # another case, another seed
        **given,
        **more,
    }


def table(rows):
    return pd.DataFrame(rows)


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


def sections(rows, facts=None, folder="DIR"):
    """The lines of a report by the title of their section."""
    text = "\n".join(report_lines(comparable_results(table(rows), folder), facts or {}, folder))
    return {part.split("\n")[0]: part.split("\n")[1:] for part in text.split("## ")[1:]}


def cells(lines):
    """The cells of all rows of tables among lines, without headings."""
    rows = [re.split(r" (?<!\\)\| ", line[2:-2]) for line in lines if line.startswith("|")]
    heads = [i for i, row in enumerate(rows) if row[0] == "---"]
    return [row for i, row in enumerate(rows) if i not in heads and i + 1 not in heads]


def test_runs_with_motors_have_figures_of_them():
    with_motors, without = (sections(grid(["qp", "eq10"], torque=torque)) for torque in (0.5, 0.0))
    for column in MOTORS:
        assert any(column.heading in line for line in with_motors["Overall"])
        assert not any(column.heading in line for line in without["Overall"])
    assert "torque motors" in with_motors["Limits of the comparison"][1]
    assert "followed exactly" in without["Limits of the comparison"][1]


# --- statistics -----------------------------------------------------------------------------------------------------


def test_a_rate_as_in_print():
    """Newcombe, Statistics in Medicine 17 (1998), table I, method 3."""
    printed = {
        (81, 263): (0.2553, 0.3662),
        (15, 148): (0.0624, 0.1605),
        (0, 20): (0.0, 0.1611),
        (1, 29): (0.0061, 0.1718),
    }
    for (won, trials), limits in printed.items():
        assert rate(np.arange(trials) < won) == pytest.approx((won / trials, *limits), abs=6e-5)


@pytest.mark.parametrize("count", [8, 40])
@pytest.mark.parametrize(("estimate", "truth"), [(mean, 1.0), (median, np.log(2.0))])
def test_intervals_hold_the_truth_of_exponential_values(estimate, truth, count):
    """About as often as they say; the skew costs the mean of few something."""
    draw = np.random.default_rng(count)
    held = [low <= truth <= high for _, low, high in (estimate(draw.exponential(size=count)) for _ in range(150))]
    assert (0.9 if estimate is median else 0.82) <= np.mean(held) <= 1.0


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


@settings(max_examples=20)
@given(st.randoms(use_true_random=False))
def test_results_are_values_by_case_and_entrant_whatever_the_order_of_rows(random):
    rows = grid(["a", "b", "c"], cases=5)
    random.shuffle(rows)
    found = results_of(table(rows), ["c"])
    assert found.entrants == ["c", "a", "b"] and found.families == ["field 0", "field 1"] and found.cases == 5
    values = {(r["entrant"], r["case"]): r["tracking_error"] for r in rows}
    for family in (None, "field 0", "field 1"):
        cases = sorted({(r["family"], r["case"]) for r in rows if family in (None, r["family"])})
        expected = [[values[entrant, case] for entrant in found.entrants] for _, case in cases]
        assert found.table("tracking_error", family).tolist() == expected


@pytest.mark.parametrize("changed", [{"settings": "new"}, {"version": "2"}])
def test_results_do_not_mix_settings_and_versions(changed):
    rows = grid(["a", "b"], cases=4)
    anew = [{**r, **changed, "tracking_error": 1.0} for r in rows if r["entrant"] == "a"][:3]
    found = results_of(table(rows + anew))
    assert found.replaced == 4  # the fourth case, too: it was run by another a
    assert list(found.missing()) == [("a", "field 1", 1)]
    assert found.table("tracking_error")[:, 0].tolist() == [1.0, 1.0, 1.0]


def test_results_count_changed_family_once():
    """A family that was changed does not count twice."""
    before = [row(name, f"before {k}", seed=k, success=name == "qp") for k in range(3) for name in ("qp", "eq10")]
    after = [row(name, f"after {k}", seed=k, success=name == "eq10") for k in range(2) for name in ("qp", "eq10")]
    results = results_of(table([*before, *after]), ("qp", "eq10"))
    assert results.table("success").sum(axis=0).tolist() == [1, 2]  # the third seed is as it was
    assert results.replaced == 4 and results.cases == 3
    one_alone = results_of(table([*before, *after[:1]]), ("qp", "eq10"))  # then there is nothing to compare it with
    assert list(one_alone.missing()) == [("eq10", "field", 1)] and one_alone.replaced == 2


def test_a_missing_run_excludes_its_case_and_others_count():
    rows = grid(["a", "b"], cases=30)
    gone = next(r for r in rows if r["entrant"] == "b" and r["family"] == "field 1")
    rows.remove(gone)
    found = sections(rows)
    points = found["What this was made on"]
    assert "- b has not run 1 cases of field 1, which count for no entrant." in points
    assert any("29 cases that every entrant has run" in point for point in points)
    assert "14 cases, on panda." in found["Family: field 1"]
    for title, family in (("Overall", "field"), ("Family: field 0", "field 0"), ("Family: field 1", "field 1")):
        shown = {line[1]: line[2].split()[0] for line in cells(found[title])[:2]}
        for entrant in ("a", "b"):
            own = [r for r in rows if r["entrant"] == entrant and r["family"].startswith(family)]
            share = np.mean([r["success"] for r in own if r["case"] != gone["case"]])
            assert shown[entrant] == f"{100 * share:.0f}"


def test_results_replace_non_finite_figures_by_the_worst():
    rows = grid(["a", "b"], cases=4)
    worst = {name: max(r[name] for r in rows) for name in ("tracking_error", "jerk")}
    deepest = min(r["min_distance"] for r in rows)
    rows[0] |= {"tracking_error": float("nan"), "jerk": float("inf"), "min_distance": float("nan")}
    rows[1] |= {"min_distance": float("inf")}  # nothing to touch: a figure as good as any
    found = results_of(table(rows))
    first, second = found.runs.iloc[0], found.runs.iloc[1]
    assert found.bounded == 3
    assert first["tracking_error"] == worst["tracking_error"] and first["jerk"] == worst["jerk"]
    assert first["min_distance"] <= deepest and second["min_distance"] == np.inf
    assert "nan" not in str(sections(rows).values())


def test_report_without_common_case_names_remedy(tmp_path):
    with pytest.raises(ConfigError, match="no runs to report; `qpavoid bench run` makes some"):
        comparable_results(table([row()])[:0], tmp_path)
    with pytest.raises(ConfigError, match="no case was run by all of a, b, b has run the fewest"):
        comparable_results(table([row("a", "1"), row("a", "2"), row("b", "3")]), tmp_path)
    with pytest.raises(ConfigError, match="no results here"):
        write_report(tmp_path)


# --- what is written ------------------------------------------------------------------------------------------------

NASTY = "<b>a|b</b> $x$ & `c` __d__"


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A folder with a report on entrants and failures that a page may stumble over."""
    folder = tmp_path_factory.mktemp("a folder")
    entrants = {f"of {NASTY}": {"name": NASTY, "says": NASTY, "settings": {"solver": NASTY}}}
    facts = {"title": NASTY, "machine": {"cpu": NASTY}, "versions": {"numpy": "2"}, "absent": {"placo": ["placo"]}}
    with Store(folder) as store:
        store.begin({**facts, "entrants": entrants})
        for one in grid(["qp", NASTY, "$y", "tracking"], failure=f"ValueError: {NASTY}\nsecond line", failed=0.5):
            store.add("runs", one)
        store.fail({"family": "field 0", "seed": 99, "entrant": None, "failure": NASTY})
    return folder, write_report(folder)


def test_report_is_well_formed_markdown_with_pictures(written):
    folder, files = written
    assert {file.suffix for file in files} == {".md", ".png"} and all(f.stat().st_size > 1000 for f in files)
    text = (folder / "report.md").read_text()
    assert sorted(re.findall(r"!\[.*?\]\((.*?)\)", text)) == sorted(f.name for f in files if f.suffix == ".png")
    escaped = r"\<b\>a\|b\</b\> $x$ & \`c\` \_\_d\_\_"
    assert f"| {escaped} |" in text and f"ValueError: {escaped} second line |" in text
    assert "placo does not take part: it needs placo." in text
    assert r"- field 0, seed 99: could not be made: `<b>a\|b</b> $x$ & 'c' __d__`" in text
    lines, tables = text.splitlines(), 0
    for i, line in enumerate(lines):
        if not line.startswith("|"):
            continue
        count = len(re.findall(r"(?<!\\)\|", line))
        if not lines[i - 1].startswith("|"):
            tables += 1
            assert lines[i - 1] == "" and lines[i + 1].count("---") == count - 1
            expected = count
        assert line.endswith(" |") and count == expected
    assert tables == 2 + 2 + 1 + 2 * 2 + 1 + 1 + 1  # who, how; overall; beside; two families; worst; failures; others


def test_the_command_writes_the_same_report_again(cli, written):
    folder, files = written
    before = {file: file.read_bytes() for file in files}
    done = cli("bench", "report", folder)
    assert done.status == 0 and done.stdout.split("\n")[:-1] == [str(file) for file in files]
    assert {file: file.read_bytes() for file in files} == before
    assert cli("bench", "report", folder / "nowhere").status == 2


def test_worst_runs_are_the_deepest_then_those_that_stop_shortest(tmp_path):
    runs = [
        row(case="1", seed=1, success=False, collided=True, min_distance=-0.002, contacts=1),
        row(case="2", seed=2, success=False, final_error=0.5),
        row(case="3", seed=3, success=False, final_error=0.1, stuck=True),
        row(case="4", seed=4, success=False, collided=True, min_distance=-0.03, contacts=2),
        row(case="5", seed=5),
    ]
    facts = {"entrants": {"of qp": {"name": "qp", "says": "", "settings": {"file": "my law.py", "digest": "0"}}}}
    rows = cells(sections(runs, facts, tmp_path / "a folder")["Worst runs"])
    assert [line[2] for line in rows] == ["4", "1", "2"]
    faults = ["2 contacts, 30.0 mm deep", "1 contacts, 2.0 mm deep", "500 mm short of its goal"]
    assert [line[4] for line in rows] == faults
    assert shlex.split(rows[0][5].strip("`"))[-2:] == ["--entrant", "my law.py:qp"]
    line = rerun_line(row("my law", family="situation1", seed=7), tmp_path / "a folder")
    assert line == f"qpavoid bench show '{tmp_path / 'a folder'}' --family situation1 --seed 7 --entrant 'my law'"


def test_report_counts_failures():
    runs = [row(case=str(k), failure="" if k < 2 else f"said {k % 2}" if k < 7 else "said 0") for k in range(9)]
    assert cells(sections(runs)["Failures"]) == [["qp", "5", "said 0"], ["qp", "2", "said 1"]]


def test_report_units():
    """A column's scale is that from the unit of the score to the unit of its heading."""
    score_units = {"[mm]": ("[m]", 1e3), "[%]": ("", 100.0), "[µs]": ("[µs]", 1.0)}
    for column in (*SHOWN, *MORE, *MOTORS):
        unit = re.search(r"\[.*\]", column.heading)[0]
        assert column.name in COLUMNS
        assert column.scale == score_units.get(unit, (unit, 1.0))[1], column.heading


def test_report_names_what_is_missing():
    runs = [row(name, str(k), seed=k, version="1") for k in (3, 4, 7) for name in ("qp", "pink")]
    entrants = {name: {"name": name, "says": "", "settings": {}} for name in ("qp", "hqp")}
    facts = {"families": ["field", "shelf"], "first_seed": 3, "seeds": 4, "entrants": entrants}
    facts["absent"] = {"pink": ["pin-pink"], "mink": ["mink"]}  # pink has run here before
    facts["failures"] = [
        {"family": "shelf", "seed": k, "entrant": who, "failure": "no\nway"} for who in (None, "hqp") for k in range(7)
    ]

    def points(runs, facts):
        return [line[2:] for line in sections(runs, facts)["What this was made on"] if line][1:]

    assert points(runs, facts) == [
        "No entrant has run 2 of the 4 cases of field that the suite asks for.",
        "No entrant has run 4 of the 4 cases of shelf that the suite asks for.",
        "mink does not take part: it needs mink.",
        "hqp was to take part, and has no run.",
        "shelf, seed 0, 1, 2, 3, 4, …: could not be made: `no way`",
        "shelf, seed 0, 1, 2, 3, 4, …: could not be run by hqp: `no way`",
    ]
    whole = {"families": ["field"], "first_seed": 3, "seeds": 2, "entrants": {"qp": entrants["qp"]}}
    assert not points(runs, whole) and not points(runs, {})
    (mixed,) = points([row("qp", version="2"), row("eq10", version="1")], {})
    assert "different versions" in mixed and "eq10 1, qp 2" in mixed


# --- pictures -------------------------------------------------------------------------------------------------------


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
