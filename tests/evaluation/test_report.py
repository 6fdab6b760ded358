import base64
from html.parser import HTMLParser

import numpy as np

from jaxloc.evaluation import plots
from jaxloc.evaluation.report import Highlight, Section, Table, encode_figure, render_report


class Page(HTMLParser):
    """Collects words and sources, and checks that every tag is closed."""

    def __init__(self, text):
        super().__init__()
        self.open, self.words, self.sources = [], [], []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        if tag not in ("meta", "img", "link"):
            self.open.append(tag)
        self.sources += [value for name, value in attributes if name in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data.strip())


def test_the_page_holds_everything_and_escapes_text():
    figure = plots.draw_drift(np.arange(4.0), np.ones(4))
    table = Table(("metric", "value"), (("a", "1"), ("<b>", "2 & 3")))
    sections = [
        Section("Drift", "<script>alert(1)</script>", figure),
        Section("Photo", figure=figure, raster=True),
        Section("Numbers", table=table),
    ]
    text = render_report("Run <1>", sections, summary="short", highlights=(Highlight("drift", "0.5 %"),))
    page = Page(text)
    assert "<script>" not in text
    for word in ("Run <1>", "<script>alert(1)</script>", "0.5 %", "drift", "<b>", "2 & 3", "short"):
        assert word in page.words
    kinds = [source.split(";")[0] for source in page.sources]
    assert kinds == ["data:image/svg+xml", "data:image/png"]
    assert "http://" not in text and "https://" not in text


def test_figures_are_encoded():
    figure = plots.draw_drift(np.arange(4.0), np.ones(4))
    png = base64.b64decode(encode_figure(figure, raster=True).partition(",")[2])
    assert png.startswith(b"\x89PNG")
    assert b"<svg" in base64.b64decode(encode_figure(figure).partition(",")[2])
