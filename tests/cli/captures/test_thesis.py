"""``thesis``: tables and figures of the report, with their verdicts, and errors of the command."""

import re
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.cli.main import main
from tests.calibration.simulated_relaxation import relaxation
from tests.command_line import error, run

TABLES = [str(n) for n in range(2, 14)]
"""Numbers of the tables with recomputed values. Table 1 contains inputs."""
FIGURES = [str(n) for n in (*range(3, 9), 10, *range(13, 18), *range(19, 24), *range(26, 40), 41, 42)]
"""Numbers of the drawn figures. Figure 9 is a block diagram."""
RELAXATION, SLOW, FAST, STEPS = (
    "cell5_relaxation_c2.csv.gz",
    "cell1_discharge_c4.csv.gz",
    "cell1_discharge_1c5.csv.gz",
    "cell5_random_steps.csv.gz",
)
NO_DATA, CONTRADICTED = "no data printed", "contradicted by the thesis's own numbers"
"""Verdicts of the report."""


class ReportParser(HTMLParser):
    """Parser of the report.

    Attributes:
        articles: For each article (a table or figure) its number, title, verdict and reason, the headings and the number
            of rows of its table, and the number of shapes drawn.
        loaded_urls: URLs that a browser loads for the report.
    """

    def __init__(self, text):
        super().__init__()
        self.articles, self.loaded_urls = {}, []
        self._article, self._field = None, None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        if tag in ("script", "img", "iframe", "link", "object", "embed", "image", "use"):
            self.loaded_urls += [
                attributes[key] for key in ("src", "href", "xlink:href", "data") if attributes.get(key)
            ]
        if tag == "article":
            fields = {"number": "", "title": "", "verdict": "", "reason": "", "heads": [], "rows": 0, "shapes": 0}
            self._article = self.articles.setdefault(attributes["id"], fields)
            assert self._article is fields, f"{attributes['id']} appears twice"
        elif self._article is not None:
            words = (attributes.get("class") or "").split()
            if "no" in words:
                self._field = "number"
            elif "badge" in words:
                self._field = "verdict"
            elif "reason" in words:
                self._field = "reason"
            elif tag == "th":
                self._article["heads"].append("")
                self._field = "heads"
            self._article["rows"] += tag == "tr"
            self._article["shapes"] += tag == "path"

    def handle_endtag(self, tag):
        if tag == "article":
            self._article = None
        if tag in ("span", "p", "th", "article"):
            self._field = "title" if self._field == "number" else None  # the title follows the number

    def handle_data(self, data):
        if self._article is None or self._field is None:
            return
        if self._field == "heads":
            self._article["heads"][-1] += data
        else:
            self._article[self._field] += data


@pytest.fixture(scope="module")
def report_text(tmp_path_factory):
    """Return the HTML text of the report, which is computed once."""
    out = tmp_path_factory.mktemp("thesis")
    with pytest.raises(SystemExit) as ended:
        main(["thesis", "--out", str(out)])
    assert not ended.value.code
    assert [path.name for path in out.iterdir()] == ["index.html"]
    return (out / "index.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def report(report_text):
    """Return the parsed report."""
    return ReportParser(report_text)


@pytest.mark.thorough
def test_tables_have_printed_and_recomputed_columns(report):
    for key in TABLES:
        table = report.articles[f"table-{key}"]
        heads = " | ".join(table["heads"])
        assert "printed" in heads, key
        assert re.search(r"recomputed|mean %|mean \(5\.1\)|mean over the loads", heads), (key, heads)
        assert table["rows"] > 2, key


@pytest.mark.thorough
def test_every_figure_is_drawn(report):
    for key in FIGURES:
        assert report.articles[f"figure-{key}"]["shapes"] > 5, key
    assert report.articles["figure-9"]["verdict"] == "given"
    assert "A block diagram" in report.articles["figure-9"]["reason"]


@pytest.mark.thorough
def test_every_item_has_a_verdict_and_a_reason(report):
    fits = {f"fitted, {count} free parameters" for count in (2, 7, 8)}
    verdicts = {*fits, "recomputed", NO_DATA, CONTRADICTED, "given", "added"}
    for key, article in report.articles.items():
        assert article["verdict"] in verdicts, key
        assert len(article["reason"]) > 30, key
    assert {article["verdict"] for article in report.articles.values()} == verdicts


@pytest.mark.thorough
def test_items_from_unpublished_recordings_are_not_called_reproduced(report):
    for key in ("8", "9", "11", "13"):
        article = report.articles[f"table-{key}"]
        assert article["verdict"] == NO_DATA
        assert "not published" in article["reason"]


@pytest.mark.thorough
def test_a_fit_gives_the_number_of_its_free_parameters(report):
    fits = {
        key: article["verdict"] for key, article in report.articles.items() if article["verdict"].startswith("fitted")
    }
    free = {"table-2": 2, "table-3": 2, "table-5": 8, "table-10": 7}
    assert fits == {key: f"fitted, {count} free parameters" for key, count in free.items()}


@pytest.mark.thorough
def test_items_without_data_are_not_contradicted(report):
    contradicted = {key for key, article in report.articles.items() if article["verdict"] == CONTRADICTED}
    assert contradicted == {"table-4", "table-6", "table-7", "table-12", "figure-20"}
    recordings = [
        article for article in report.articles.values() if "recordings are not published" in article["reason"]
    ]
    assert [article["verdict"] for article in recordings].count(NO_DATA) == 17


@pytest.mark.thorough
def test_report_states_that_only_the_text_was_available(report_text):
    assert "Only the text of the thesis with its numbers and tables was available" in report_text


@pytest.mark.thorough
def test_numbers_of_verdicts_agree_with_the_documentation(report):
    text = (Path(__file__).parents[3] / "docs" / "theory" / "thesis.md").read_text(encoding="utf-8")
    verdicts = [item["verdict"].partition(",")[0] for item in report.articles.values() if item["verdict"] != "added"]
    for verdict, count in Counter(verdicts).items():
        assert f"| {verdict} | {count} |" in text


@pytest.mark.thorough
def test_report_loads_no_other_files(report_text, report):
    assert report.loaded_urls == [target for target in report.loaded_urls if target.startswith("#")]
    assert not re.search(r"@import|url\(\s*[\"']?(?!#)", report_text)
    assert not re.search(r"(?:src|href)\s*=\s*[\"'](?:https?:)?//", report_text)


@pytest.mark.thorough
def test_closing_note_lists_every_item(report_text, report):
    note = report_text.split('id="summary"', 1)[1]
    for key in report.articles:
        assert f'href="#{key}"' in note


def cells(report_text, key):
    """Return the cells of the table of one article, by rows."""
    article = re.search(rf'<article id="{key}">.*?</article>', report_text, re.DOTALL).group()
    return [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in re.findall(r"<tr>(<td.*?)</tr>", article)]


@pytest.mark.thorough
def test_errata_are_numbered(report_text):
    assert [row[0] for row in cells(report_text, "table-errata")] == [f"E{n}" for n in range(1, 38)]


@pytest.mark.thorough
def test_tables_2_and_3_are_reproduced_from_one_initial_state(report_text):
    """All printed digits (four to seven) agree; the small parameters of Table 3 keep their initial values."""
    for key in ("table-2", "table-3"):
        rows = cells(report_text, key)
        assert len(rows) == 15
        for row in rows:
            printed, recomputed = float(row[3]), float(row[4])
            assert recomputed == pytest.approx(printed, rel=2e-5), (key, row)


@pytest.mark.thorough
def test_small_parameters_of_table_3_keep_the_errors_of_their_initial_values(report_text):
    errors_percent = {row[0]: float(row[8]) for row in cells(report_text, "table-3")}
    assert [errors_percent[f"a{i}"] for i in (1, 3, 6, 13, 15)] == pytest.approx(
        [6.48, 14.3, 19.7, 36.0, 5.99], abs=0.05
    )


@pytest.mark.thorough
def test_dynamic_error_of_table_12_is_smaller_than_the_static_one_only_with_refitted_parameters(report_text):
    dynamic, static = ([float(cell) for cell in row[2:]] for row in cells(report_text, "table-12"))
    assert (dynamic[0], static[0]) == pytest.approx((0.0826, 0.0812), abs=5e-5)
    assert dynamic[2] < 0.5 * static[2]  # with refitted a13 to a15


def test_option_table_selects_one_table(tmp_path, capsys):
    code, out, err = run(capsys, "thesis", "--table", "5", "--out", tmp_path)
    assert (code, err) == (0, "")
    assert "Table 5" in out
    assert "3666.67" in out  # the recomputed parameter a12
    report = ReportParser((tmp_path / "index.html").read_text(encoding="utf-8"))
    assert list(report.articles) == ["table-5"]


def test_option_figure_selects_one_figure(tmp_path, capsys):
    code, out, _ = run(capsys, "thesis", "--figure", "19", "--out", tmp_path)
    assert code == 0
    assert "Figure 19" in out
    report = ReportParser((tmp_path / "index.html").read_text(encoding="utf-8"))
    assert list(report.articles) == ["figure-19"]
    assert report.articles["figure-19"]["shapes"] > 5


def test_user_errors_end_with_code_2(tmp_path, capsys, data):
    constant_load, relaxation_test = data / "leaf" / "cc_1c.csv.gz", tmp_path / "rests.csv"
    rows = relaxation()[["time_s", "current_a", "voltage_v"]]
    np.savetxt(relaxation_test, rows, delimiter=",", header="time_s,current_a,voltage_v", comments="", fmt="%.6f")
    for arguments, words in (
        (("--table", "14"), "no table 14: tables are 1 to 13"),
        (("--figure", "51"), "no figure 51"),
        ((constant_load,), "captures require --cell"),
        ((relaxation_test, "--cell", "ncr18650"), "the protocol needs a constant load"),
        ((constant_load, "--cell", "leaf"), "the protocol needs a voltage relaxation test"),
    ):
        code, out, err = run(capsys, "thesis", *arguments, "--out", tmp_path / "none")
        assert (code, out) == (2, "")
        assert words in " ".join(err.split())
        assert "Traceback" not in err
        assert not (tmp_path / "none").exists()
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert "cannot be written" in error(run(capsys, "thesis", "--table", "1", "--out", blocked))


def test_chapter_5_runs_on_real_captures(tmp_path, capsys, shared_data):
    captures = [shared_data / "ncr18650" / name for name in (RELAXATION, SLOW, FAST, STEPS)]
    code, out, _ = run(capsys, "thesis", *captures, "--cell", "ncr18650", "--table", "11", "--out", tmp_path)
    assert code == 0
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "4 captures of" in text
    # mean current [A], use in the procedure, printed mean error [%], and mean [%], maximum [%] and RMS [mV] of the error
    expected_rows = {
        "cell1_discharge_c4": "0.77 step 2 - 0.419 4.99 27.6",
        "cell1_discharge_1c5": "4.62 validation - 5.31 25.8 195",
        "cell5_random_steps": "2.35 validation - 0.284 4.05 13.9",
    }
    for name, values in expected_rows.items():
        row = next(line for line in out.splitlines() if name in line)
        assert " ".join(row.split()).startswith(f"{name} {values} ")
    assert "claim tested on other data: fails" in out
    assert "met on 0 of 1 captures (values 5.31)" in " ".join(out.split())
    code, out, _ = run(capsys, "thesis", *captures, "--cell", "ncr18650", "--table", "8", "--out", tmp_path)
    assert code == 0
    residual_mv = float(re.search(r"joint fit ([\d.]+) \(", " ".join(out.split())).group(1))
    assert residual_mv == pytest.approx(9.57, abs=0.01)
