"""Report pages: what they say, that they are safe and whole, that they need nothing else."""

import base64
import json
import re

import jinja2
import numpy as np
import plotly.graph_objects as go
import pytest

from nerf2real.core.pages import blocks, charts, page
from nerf2real.core.pages.blocks import Chart, Figure, Figures, Grid, Picture, Table
from nerf2real.core.pages.charts import Curve
from nerf2real.core.pages.page import Origin, Page, Section

EVIL = "<script>alert('a')</script> & \"more\""
IMAGE = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)


def written(tmp_path, *content, **fields):
  path = tmp_path / "report.html"
  page.write(path, Page("Title", "Lead.", [Section("Part", "Text.", content)], **fields))
  assert [file.name for file in tmp_path.iterdir()] == ["report.html"]
  return path.read_text()


def figures_in(text):
  return [json.loads(found) for found in re.findall(r"<script>plot\((.*), (?:true|false)\)", text)]


def array(spec):
  return np.frombuffer(base64.b64decode(spec["bdata"]), spec["dtype"])


def test_every_text_is_escaped(tmp_path):
  text = written(
    tmp_path,
    blocks.Text(EVIL),
    blocks.Heading(EVIL),
    blocks.Warnings([EVIL]),
    blocks.Notes([EVIL]),
    blocks.Answers([blocks.Answer(EVIL, EVIL, [EVIL], bars={EVIL: 1.0})]),
    Picture(IMAGE, EVIL),
    Table([EVIL], [[EVIL]]),
    Figures([Figure(EVIL, EVIL, EVIL, EVIL, EVIL)]),
    blocks.Times({EVIL: 1.0}),
    blocks.Legend({EVIL: "red"}),
    blocks.Preformatted(EVIL),
    blocks.Details(EVIL, [blocks.Text(EVIL)]),
    charts.lines(EVIL, EVIL, EVIL, [Curve(EVIL, "red", np.zeros(2), np.zeros(2))]),
    warnings=[EVIL],
    origin=Origin(EVIL, EVIL),
  )
  assert "alert('a')" not in text and text.count("alert(&#39;a&#39;)") == 25
  (figure,) = figures_in(text)
  assert figure["data"][0]["name"] == figure["layout"]["title"]["text"] == EVIL


def test_page_needs_no_other_file_and_holds_plotly_once_where_a_chart_is(tmp_path):
  text = written(tmp_path, Picture(IMAGE), Table(["a"], [[1]]))
  assert len(text) < 10_000 and "Plotly" not in text
  chart = charts.figure_3d([charts.path_trace(np.eye(3))])
  text = written(tmp_path, blocks.Details("more", [Grid([None, chart, chart], 2)]))
  assert text.count("plotly.js v") == 1 and len(figures_in(text)) == 2
  outside = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
  assert "http" not in outside and "<link" not in outside


def test_figures_have_a_column_for_what_is_good_only_where_it_is_known(tmp_path):
  known = written(tmp_path, Figures([Figure("error", 0.123456, "m", "of all", "lower")]))
  assert "<th>good is</th>" in known and '<td class="good">lower</td>' in known
  assert '<td class="value number">0.1235</td><td class="unit">m</td>' in known
  assert "<th>good is" not in written(tmp_path, Figures([Figure("parts", 3)]))


def test_a_sentence_among_figures_may_wrap_and_a_number_may_not(tmp_path):
  text = written(tmp_path, Figures([Figure("place", "it lies there"), Figure("parts", 3)]))
  assert '<td class="value">it lies there</td>' in text
  assert '<td class="value number">3</td>' in text
  assert "td.value { white-space: nowrap" not in text and "td.number { white-space: nowrap" in text


def test_origin_is_shown_where_it_is_given(tmp_path):
  assert "<footer>" not in written(tmp_path)
  text = written(tmp_path, origin=Origin(command="make demo", version="0.1"))
  assert "<code>make demo</code>" in text and "0.1" in text


def test_origin_of_a_process_is_its_command(monkeypatch):
  monkeypatch.setattr("sys.argv", ["launch/evaluate.py", "--out", "a b"])
  assert Origin.of_process().command == "launch/evaluate.py --out 'a b'"
  monkeypatch.setattr("sys.argv", ["/opt/bin/nerf2real", "evaluate"])
  assert Origin.of_process().command == "nerf2real evaluate"


def test_times_are_bars_with_their_total(tmp_path):
  text = written(tmp_path, blocks.Times({"poses": 2.0, "field": 6.0}))
  assert "width: 33.3%" in text and "width: 100.0%" in text and "8.0 s" in text
  assert "0.0 s" in written(tmp_path, blocks.Times({}))


def test_a_page_that_cannot_be_made_leaves_the_old_one(tmp_path):
  path = tmp_path / "report.html"
  path.write_text("old")
  with pytest.raises(TypeError, match="object"):
    figure = go.Figure(layout={"height": 10, "meta": object()})
    page.write(path, Page("", "", [Section("", "", [Chart(figure)])]))
  assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 1


def test_own_templates_have_the_look_and_must_be_given_their_names(tmp_path):
  (tmp_path / "own.html").write_text(
    '{% extends "base.html" %}{% block body %}<p>{{ name }}</p><script>{{ data | tojson }}</script>'
    "{% endblock %}"
  )
  data = Figure("</script>", np.float32(0.5), good=None)
  text = page.render(tmp_path / "own.html", plots=False, name="a<b", data=data)
  assert "<p>a&lt;b</p>" in text and "--accent" in text
  assert '"value":0.5' in text and '"good"' not in text and text.count("</script>") == 1
  with pytest.raises(jinja2.UndefinedError, match="name"):
    page.render(tmp_path / "own.html", plots=False, data=data)


def test_long_curves_are_thinned_and_keep_single_precision(tmp_path):
  time = np.linspace(0, 40, 100_000)
  chart = charts.lines("", "time [s]", "angle [rad]", [Curve("a", "red", time, np.sin(time))])
  text = written(tmp_path, chart)
  (figure,) = figures_in(text)
  x, y = (array(figure["data"][0][axis]) for axis in "xy")
  assert 1000 < len(x) <= 1300 and x.dtype == np.float32
  np.testing.assert_allclose(y, np.sin(x.astype(float)), atol=1e-5)
  assert figure["layout"]["xaxis"]["title"]["text"] == "time [s]"
  assert "template" not in figure["layout"]


def test_binned_curves_are_quartiles():
  x = np.repeat(np.arange(48.0), 5)
  y = np.tile([0.0, 1, 2, 3, 4], 48) + x
  (trace,) = charts.binned("", "x", "y", [Curve("a", "red", x, y)]).figure.data
  assert len(trace.x) == 24
  np.testing.assert_allclose(np.subtract(trace.y, trace.x), 2.0, atol=0.6)
  np.testing.assert_allclose(trace.error_y.array, 1.0, atol=0.6)


def test_intervals_are_relative_to_their_values():
  chart = charts.intervals("", [charts.Interval("a", -2.0, -2.2, -1.0)])
  (trace,) = chart.figure.data
  assert trace.error_x.array == pytest.approx([50.0])
  assert trace.error_x.arrayminus == pytest.approx([10.0])
  assert charts.intervals("", [charts.Interval("zero", 0.0, -1.0, 1.0)]) is None
  assert charts.intervals("", [charts.Interval("nothing is known of it", 1e-6, -1.0, 1.0)]) is None


def test_bars_run_from_top_to_bottom():
  chart = charts.bars("", "m", [charts.Bars("a", "red", [1, 2])], ["first", "second"])
  (trace,) = chart.figure.data
  assert list(trace.y) == ["second", "first"] and list(trace.x) == [2, 1]
