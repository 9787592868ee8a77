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

from makebreak.gap.data.recording import unit_of
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
_MOST_SAMPLES = 800  # Of a line of a whole recording.
# What columns of bodies and wrenches are, three or four to a row.
_SAYS = (
    dict.fromkeys("xyz", "place x, y, z [m]")
    | dict.fromkeys(("qw", "qx", "qy", "qz"), "orientation, quaternion")
    | dict.fromkeys(("vx", "vy", "vz"), "velocity x, y, z [m/s]")
    | dict.fromkeys(("wx", "wy", "wz"), "angular velocity x, y, z [rad/s]")
    | dict.fromkeys(("fx", "fy", "fz"), "force x, y, z [N]")
    | dict.fromkeys(("tx", "ty", "tz"), "torque x, y, z [N m]")
)


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
    return _plot(_figure(series, units), instead) if series else ""


def recording_html(columns: Mapping[str, np.ndarray]) -> str:
    """What a recording has, as series_html: a row for each quantity with a line for
    each place. Args: columns: of the table of a recording."""
    time = np.asarray(columns["time"], dtype=float)
    rows: dict[str, dict[str, np.ndarray]] = {}
    for name, values in columns.items():
        at, _, quantity = name.rpartition(".")
        if at and np.isfinite(values).any():
            says = _SAYS.get(quantity, f"{quantity} [{_unit(quantity)}]")
            rows.setdefault(says, {})[name] = np.asarray(values, dtype=float)
    if not rows:
        return ""
    step = max(-(-len(time) // _MOST_SAMPLES), 1)
    t = time[::step]
    ends = np.flatnonzero(np.diff(t) <= 0.0) + 1  # Of episodes: a line ends there.
    layout = _layout(len(rows))
    layout |= {"hovermode": "closest", "showlegend": False}
    traces = []
    for k, (says, lines) in enumerate(rows.items()):
        axis = str(k + 1) if k else ""
        bottom, top = _row(k, len(rows))
        layout[f"xaxis{axis}"] = {"anchor": f"y{axis}", "gridcolor": "#edf2f7"}
        if k:
            layout[f"xaxis{axis}"]["matches"] = "x"
        layout[f"yaxis{axis}"] = _values_axis(axis, [bottom, top])
        layout["annotations"].append(_title(says, 0.0, top))
        for name, values in lines.items():
            x, y = np.insert(t, ends, np.nan), np.insert(values[::step], ends, np.nan)
            traces.append({
                "type": "scatter", "mode": "lines", "name": name, "x": _plain(x, 10),
                "y": _plain(y, 5), "xaxis": f"x{axis}", "yaxis": f"y{axis}",
                "line": {"width": 1.2}, "hoverlabel": {"namelength": -1},
            })  # fmt: skip
    layout[f"xaxis{axis}"]["title"] = {"text": "time [s]"}
    return _plot({"data": traces, "layout": layout}, "")


def _unit(quantity: str) -> str:
    """Of a recording's column; of joints whose kind nobody tells here, both."""
    both = dict.fromkeys((unit_of(quantity), unit_of(quantity, prismatic=True)))
    return " or ".join(both)


def _plot(figure: dict, instead: str) -> str:
    text = json.dumps(figure, allow_nan=False).replace("<", "\\u003c")
    script = _SCRIPT % {"figure": text, "library": _library()}
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
    layout = _layout(len(series))
    first: dict[tuple[str, int], str] = {}  # The time axis of a recording's episode.
    for k, each in enumerate(series):
        height = _row(k, len(series))
        left, right = axis_of(k), str(2 * k + 2)
        for axis, domain in ((left, [0.0, 0.57]), (right, [0.65, 1.0])):
            key = (each.recording, each.episode)
            time = {"domain": domain, "anchor": f"y{axis}", "gridcolor": "#edf2f7"}
            if key in first:  # One zoom for all that have the same clock.
                time["matches"] = first[key]
            first.setdefault(key, f"x{axis}")
            layout[f"xaxis{axis}"] = time
            layout[f"yaxis{axis}"] = _values_axis(axis, height)
        unit = f" [{units[each.channel]}]" if units.get(each.channel) else ""
        for x, says in (
            (0.0, f"{each.channel}{unit} ({each.recording}, episode {each.episode})"),
            (0.65, f"measured - simulated{unit}; grey: expected, 2 sigma"),
        ):
            layout["annotations"].append(_title(says, x, height[1]))
        traces += _traces(each, left, right, named=k == 0)
        layout[f"yaxis{right}"]["range"] = _range(each)
    return {"data": traces, "layout": layout}


def _layout(rows: int) -> dict:
    return {
        "height": _ROW_HEIGHT * rows + 60,
        "margin": {"l": 60, "r": 10, "t": 40, "b": 40},
        "hovermode": "x",
        "plot_bgcolor": "#fff",
        "legend": {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom"},
        "annotations": [],
    }


def _row(k: int, rows: int) -> list[float]:
    """Bottom and top of row k, of the plot's height."""
    pitch = 1.0 / rows
    top = 1.0 - k * pitch
    return [top - 0.82 * pitch, top - 0.1 * pitch]


def _values_axis(axis: str, height: Sequence[float]) -> dict:
    return {
        "domain": height, "anchor": f"x{axis}", "gridcolor": "#edf2f7",
        "zerolinecolor": "#cbd5e0",
    }  # fmt: skip


def _title(says: str, x: float, y: float) -> dict:
    return {
        "text": says.replace("<", "&lt;"), "x": x, "y": y, "xref": "paper",
        "yref": "paper", "xanchor": "left", "yanchor": "bottom", "showarrow": False,
        "font": {"size": 12},
    }  # fmt: skip


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
