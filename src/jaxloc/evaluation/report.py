"""HTML reports: one self-contained page."""

import base64
import io
from importlib import resources
from typing import TYPE_CHECKING

import equinox as eqx

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Table(eqx.Module):
    """A table of words and numbers.

    Args:
        header: names of the columns.
        rows: cells, as they are to be read.
    """

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


class Section(eqx.Module):
    """A part of a report.

    Args:
        title: its headline.
        text: what is to be seen, and what it says.
        figure: a matplotlib figure.
        table: a table.
        raster: embed the figure as PNG, which suits photographs, and not as SVG.
    """

    title: str
    text: str = ""
    figure: "Figure | None" = None
    table: Table | None = None
    raster: bool = False


class Highlight(eqx.Module):
    """Key figure at the top of a report.

    Args:
        label: what it is.
        value: the number, as it is to be read, with its unit.
    """

    label: str
    value: str


def encode_figure(figure: "Figure", *, raster: bool = False) -> str:
    """Makes a figure a data URI, which a page can hold.

    Args:
        figure: a matplotlib figure.
        raster: as PNG, not as SVG.

    Returns:
        The URI.
    """
    buffer = io.BytesIO()
    if raster:
        figure.savefig(buffer, format="png", dpi=130)
    else:
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    kind = "png" if raster else "svg+xml"
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"


def render_report(
    title: str, sections: list[Section], *, summary: str = "", highlights: tuple[Highlight, ...] = ()
) -> str:
    """Renders a report.

    Args:
        title: headline of the page.
        sections: its parts, in order.
        summary: a sentence below the headline.
        highlights: numbers at the top.

    Returns:
        A self-contained HTML page; all text is escaped.

    Raises:
        ImportError: when jinja2 is not installed.

    Example:
        >>> page = render_report("A < B", [Section("Path", "from above")])
        >>> "A &lt; B" in page, "http" in page
        (True, False)
    """
    try:
        import jinja2
    except ImportError as error:
        raise ImportError('reports need jinja2: pip install "jaxloc[cli]"') from error
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    source = resources.files("jaxloc.evaluation").joinpath("report.html.jinja").read_text(encoding="utf-8")
    figures = [None if part.figure is None else encode_figure(part.figure, raster=part.raster) for part in sections]
    return environment.from_string(source).render(
        title=title, summary=summary, highlights=highlights, parts=list(zip(sections, figures, strict=True))
    )
