"""Series that can be zoomed, with values under the pointer, inside the page: Plotly.

The library is in the page, compressed (2 MB), so that it opens without a network. A
browser that cannot unpack it shows the picture that stands in its place.
"""

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import pairwise

import numpy as np

from makebreak.gap.report.pictures import (
    AFTER,
    BEFORE,
    MEASURED,
    broken,
    expected_of,
    measured_channels,
    stretch,
)
from makebreak.gap.result import Series

MOST_CHANNELS = 8
_MOST_ROWS = 2000  # Of a channel.
_ROW_HEIGHT = 250  # [pixels]


def shown_series(series: Sequence[Series]) -> list[Series]:
    """The channels that are shown, the worst first, with so many windows about the
    worst one as have not too many rows."""
    shown = []
    for each in measured_channels(series)[:MOST_CHANNELS]:
        rows_of_window = len(each.time) / max(len(each.starts), 1)
        shown.append(stretch(each, max(int(_MOST_ROWS / rows_of_window), 1)))
    return shown


def series_html(
    series: Sequence[Series], units: Mapping[str, str], instead: str
) -> str:
    """The plot and its script; "" if there is nothing to show.

    Args: series: of shown_series; units: of channels; instead: the picture (HTML) that
        is shown until the plot is there.
    """
    if not series:
        return ""
    figure = json.dumps(_figure(series, units), allow_nan=False).replace("<", "\\u003c")
    script = _SCRIPT % {"figure": figure, "library": _library()}
    return f'<div id="series">{instead}</div><script>{script}</script>'


@cache
def _library() -> str:
    from plotly.offline import get_plotlyjs  # Here: it is needed for a report only.

    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), 6)).decode()


def axis_of(k: int) -> str:
    """Plotly's number of the axes of channel k's values: the first has none."""
    return str(2 * k + 1) if k else ""


def _figure(series: Sequence[Series], units: Mapping[str, str]) -> dict:
    """Plotly's data and layout: a row for each channel, its values and its errors."""
    traces: list[dict] = []
    layout: dict = {
        "height": _ROW_HEIGHT * len(series) + 60,
        "margin": {"l": 60, "r": 10, "t": 40, "b": 40},
        "hovermode": "x",
        "plot_bgcolor": "#fff",
        "legend": {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom"},
        "annotations": [],
    }
    pitch = 1.0 / len(series)
    first: dict[tuple[str, int], str] = {}  # The time axis of a recording's episode.
    for k, each in enumerate(series):
        top = 1.0 - k * pitch
        height = [top - 0.82 * pitch, top - 0.1 * pitch]
        left, right = axis_of(k), str(2 * k + 2)
        for axis, domain in ((left, [0.0, 0.57]), (right, [0.65, 1.0])):
            key = (each.recording, each.episode)
            time = {"domain": domain, "anchor": f"y{axis}", "gridcolor": "#edf2f7"}
            if key in first:  # One zoom for all that have the same clock.
                time["matches"] = first[key]
            first.setdefault(key, f"x{axis}")
            layout[f"xaxis{axis}"] = time
            layout[f"yaxis{axis}"] = {
                "domain": height, "anchor": f"x{axis}", "gridcolor": "#edf2f7",
                "zerolinecolor": "#cbd5e0",
            }  # fmt: skip
        unit = f" [{units[each.channel]}]" if units.get(each.channel) else ""
        for x, says in (
            (0.0, f"{each.channel}{unit} ({each.recording}, episode {each.episode})"),
            (0.65, f"measured - simulated{unit}; grey: expected, 2 sigma"),
        ):
            layout["annotations"].append({
                "text": says.replace("<", "&lt;"), "x": x, "y": height[1],
                "xref": "paper", "yref": "paper", "xanchor": "left",
                "yanchor": "bottom", "showarrow": False, "font": {"size": 12},
            })  # fmt: skip
        traces += _traces(each, left, right, named=k == 0)
        layout[f"yaxis{right}"]["range"] = _range(each)
    return {"data": traces, "layout": layout}


def _traces(each: Series, left: str, right: str, named: bool) -> list[dict]:
    def trace(t, y, axis, **more):
        return {
            "type": "scatter", "x": _plain(t, 10), "y": _plain(y), "xaxis": f"x{axis}",
            "yaxis": f"y{axis}", **more,
        }  # fmt: skip

    band_t, band = [], []  # Closed shapes, one a window.
    cuts = [0, *sorted({int(s) for s in each.starts if s > 0}), len(each.time)]
    expected = expected_of(each)
    for a, b in pairwise(cuts):
        t, size = each.time[a:b], 2.0 * expected[a:b]
        band_t += [*t, *t[::-1], np.nan]
        band += [*size, *-size[::-1], np.nan]
    found = [
        trace(
            band_t, band, right, mode="lines", line={"width": 0}, fill="toself",
            fillcolor="rgba(0,0,0,.14)", hoverinfo="skip", showlegend=False,
        ),
        trace(
            each.time, each.measured, left, mode="markers", name="measured",
            marker={"size": 3, "color": MEASURED}, showlegend=named,
            legendgroup="measured",
        ),
    ]  # fmt: skip
    rows = np.flatnonzero(np.isfinite(each.measured))
    starts = np.searchsorted(rows, each.starts)
    for name, value, colour in (
        ("before", each.before, BEFORE),
        ("after", each.after, AFTER),
    ):
        more = {
            "mode": "lines", "name": name, "legendgroup": name,
            "line": {"color": colour, "width": 1.3},
        }  # fmt: skip
        t, y = broken(each.time, value, each.starts)
        found.append(trace(t, y, left, **more, showlegend=named))
        t, y = broken(each.time[rows], (each.measured - value)[rows], starts)
        found.append(trace(t, y, right, **more, showlegend=False))
    return found


def _range(each: Series) -> list[float]:
    """Of the errors: those after, and what is expected; those before may be larger by
    far."""
    error = np.abs(each.measured - each.after)
    sizes = np.append(error[np.isfinite(error)], 2.5 * expected_of(each))
    top = 1.15 * float(np.max(sizes[np.isfinite(sizes)], initial=0.0))
    return [-top, top]


def _plain(values, digits: int = 6) -> list[float | None]:
    """As short as is exact enough for a plot; None where there is no number."""
    return [
        float(f"{v:.{digits}g}") if np.isfinite(v) else None
        for v in np.asarray(values, dtype=float)
    ]


_SCRIPT = """
(async () => {
  const figure = %(figure)s;
  const packed = Uint8Array.from(atob("%(library)s"), (c) => c.charCodeAt(0));
  const unpacked = new Blob([packed]).stream().pipeThrough(
    new DecompressionStream("gzip"));
  const library = document.createElement("script");
  library.text = "" + await new Response(unpacked).text();
  document.head.append(library);
  const place = document.getElementById("series");
  place.replaceChildren();
  await Plotly.newPlot(place, figure.data, figure.layout,
    {responsive: true, displaylogo: false, modeBarButtons: [
      ["zoom2d", "pan2d", "resetScale2d", "toImage"]]});
  for (const row of document.querySelectorAll("a[data-axis]"))
    row.onclick = () => Plotly.relayout(place, {
      [`xaxis${row.dataset.axis}.range`]: [row.dataset.from, row.dataset.to]});
  document.documentElement.dataset.plotted = "yes";
})();
"""
