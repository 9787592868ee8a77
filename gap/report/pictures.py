"""Pictures of what the gap workflow found, for the report and as files."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter

from makebreak.gap.result import GapResult, Series

BEFORE, AFTER, MEASURED = "#d98032", "#2b6cb0", "#222222"
_MOST_CHANNELS = 14  # In one picture: more cannot be read.
_MOST_BINS = 600
MOST_PARAMETERS = 24  # In one picture of strips.
_MOST_WINDOWS = 8


def worst_channels(result: GapResult, most: int = _MOST_CHANNELS) -> list[str]:
    """Those with the largest error before, the worst first."""
    size = {
        name: max(_finite(each.get("before")), _finite(each.get("after")))
        for name, each in result.gap.per_channel.items()
    }
    return sorted(size, key=lambda name: -size[name])[:most]


def picture_of_channels(result: GapResult) -> Figure:
    """Held-out error of each channel, before and after, over the expected error."""
    names = worst_channels(result)
    per_channel = result.gap.per_channel
    figure = Figure(
        figsize=(6.4, 1.3 + 0.36 * max(len(names), 2)), layout="constrained"
    )
    axes = figure.add_subplot()
    rows = np.arange(len(names))
    floor = result.gap.noise_floor
    for shift, key, colour in ((-0.19, "before", BEFORE), (0.19, "after", AFTER)):
        values = [_finite(per_channel[name].get(key)) for name in names]
        axes.barh(rows + shift, values, 0.36, color=colour, label=key)
        for row, value in zip(rows, values, strict=True):
            at = max(value, _beside(value, floor))
            axes.annotate(
                f"{value:.3g}", (at, row + shift), (3, 0), fontsize=8,
                textcoords="offset points", va="center", color="0.3",
            )  # fmt: skip
    values = [_finite(v) for each in per_channel.values() for v in each.values()]
    top = max([2.0, *values])
    axes.set_xlim(min([0.5, *(0.7 * v for v in values if v > 0.0)]), 2.2 * top)
    axes.set_xscale("log")
    if np.isfinite(floor) and floor > 0.0:
        axes.axvline(floor, color="0.2", lw=1.2, ls="--", label="expected")
    _plain_numbers(axes.xaxis)
    axes.set_yticks(rows, names, fontsize=9)
    axes.invert_yaxis()
    left = len(per_channel) - len(names)
    more = f"\n(the largest; {left} more are in result.json)" if left > 0 else ""
    axes.set_xlabel(f"held-out error / expected error{more}", fontsize=9)
    axes.legend(
        fontsize=8, frameon=False, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0)
    )
    _plain(axes)
    return figure


def picture_of_where(
    result: GapResult, extents: Mapping[tuple[str, int], tuple[float, float]]
) -> Figure | None:
    """Heat map, channel by time: where the disagreement stands out.

    Args: extents: {(recording, episode): (from, to)} [s], of all that was looked at.
    Returns: None if nothing stands out.
    """
    if not result.where:
        return None
    spans = dict(extents)
    for each in result.where:  # What is told of must be shown.
        key = (each.recording, each.episode)
        low, high = spans.get(key, (each.from_s, each.to_s))
        spans[key] = (min(low, each.from_s), max(high, each.to_s))
    score: dict[str, float] = {}
    for each in result.where:
        score[each.channel] = max(score.get(each.channel, 0.0), each.score)
    names = sorted(score, key=lambda name: -score[name])[:_MOST_CHANNELS]
    total = sum(high - low for low, high in spans.values())
    bins, starts, n = {}, {}, 0
    for key, (low, high) in spans.items():
        starts[key] = n
        bins[key] = max(round(_MOST_BINS * (high - low) / max(total, 1e-9)), 1)
        n += bins[key]
    heat, held = np.full((len(names), n), np.nan), []
    for each in result.where:
        if each.channel not in names:
            continue
        key = (each.recording, each.episode)
        low, high = spans[key]
        per_second = bins[key] / max(high - low, 1e-9)
        a = starts[key] + int((each.from_s - low) * per_second)
        b = starts[key] + int(np.ceil((each.to_s - low) * per_second))
        b = min(max(b, a + 1), starts[key] + bins[key])
        row = heat[names.index(each.channel), a:b]
        row[:] = np.fmax(row, each.score)
        if each.held_out:
            held.append((a, b, names.index(each.channel)))
    figure = Figure(figsize=(10.0, 1.5 + 0.3 * len(names)), layout="constrained")
    axes = figure.add_subplot()
    axes.set_facecolor("#f3f4f6")
    top = max(2.0, float(np.nanmax(heat)))
    shown = axes.imshow(
        heat, aspect="auto", interpolation="nearest", cmap="YlOrRd",
        norm=LogNorm(1.0, top), extent=(0, n, len(names) - 0.5, -0.5),
    )  # fmt: skip
    for a, b, at in held:
        axes.plot([a, b], [at + 0.44] * 2, color="0.2", lw=1.5, solid_capstyle="butt")
    axes.set_yticks(np.arange(len(names)), names, fontsize=9)
    _time_ticks(axes, spans, starts, bins)
    bar = figure.colorbar(shown, ax=axes, pad=0.01)
    bar.set_label("error / expected error", fontsize=9)
    _plain_numbers(bar.ax.yaxis)
    return figure


def _time_ticks(axes, spans, starts, bins) -> None:
    keys = list(spans)
    for key in keys[1:]:
        axes.axvline(starts[key], color="white", lw=2.0)
    if len(keys) == 1:
        low, high = spans[keys[0]]
        times = MaxNLocator(8).tick_values(low, high)
        times = times[(times >= low) & (times <= high)]
        per_second = bins[keys[0]] / max(high - low, 1e-9)
        axes.set_xticks(
            (times - low) * per_second, [f"{t:g}" for t in times], fontsize=8
        )
        axes.set_xlabel("time [s]", fontsize=9)
    elif len(keys) <= 4:
        ticks, labels = [], []
        for key in keys:
            low, high = spans[key]
            for share in (0.0, 0.5):
                ticks.append(starts[key] + share * bins[key])
                labels.append(f"{low + share * (high - low):.3g}")
        axes.set_xticks(ticks, labels, fontsize=8)
        axes.set_xlabel("time [s]", fontsize=9)
    else:
        # One label for each part is too much: some.
        every = max(1, len(keys) // 12)
        some = keys[::every]
        # Each recording one episode: its name; else the episode's number.
        by_name = len({name for name, _ in keys}) == len(keys)
        axes.set_xticks(
            [starts[k] + 0.5 * bins[k] for k in some],
            [k[0] if by_name else str(k[1]) for k in some], fontsize=8,
        )  # fmt: skip
        what = "recording" if by_name else "episode"
        axes.set_xlabel(f"{what}, from its start to its end", fontsize=9)
    if 1 < len(keys) <= 4:
        for recording, episode in keys:
            axes.annotate(
                f"{recording}, episode {episode}",
                (starts[recording, episode] + 2, -0.6), fontsize=8, color="0.3",
                annotation_clip=False,
            )  # fmt: skip


def measured_channels(series: Sequence[Series]) -> list[Series]:
    """Those that were measured at all, the one with the largest error before first."""
    measured = [each for each in series if np.isfinite(each.measured).any()]
    return sorted(measured, key=lambda each: -_rms_before(each))


def picture_of_series(
    series: Sequence[Series], units: Mapping[str, str] | None = None, most: int = 3
) -> Figure | None:
    """Measured channels over neighbouring held-out windows: measured, before and after,
    and the errors beside what a perfect model would leave. units: of channels."""
    worst = [stretch(each) for each in measured_channels(series)[:most]]
    if not worst:
        return None
    figure = Figure(figsize=(10.0, 2.5 * len(worst) + 0.4), layout="constrained")
    grid = figure.subplots(len(worst), 2, squeeze=False, width_ratios=(3, 2))
    for (left, right), each in zip(grid, worst, strict=True):
        t = each.time
        left.plot(t, each.measured, ".", ms=2.5, color=MEASURED, label="measured")
        for value, colour, label in (
            (each.before, BEFORE, "before"),
            (each.after, AFTER, "after"),
        ):
            gapped_t, gapped = broken(t, value, each.starts)
            left.plot(gapped_t, gapped, color=colour, lw=1.3, label=label)
            # Between rows of a channel others may have rows: no break of the line.
            rows = np.flatnonzero(np.isfinite(each.measured))
            error = (each.measured - value)[rows]
            starts = np.searchsorted(rows, each.starts)
            gapped_t, gapped = broken(t[rows], error, starts)
            right.plot(gapped_t, gapped, color=colour, lw=1.0, label=label)
        expected = expected_of(each)
        band_t, band = broken(t, 2.0 * expected, each.starts)
        right.fill_between(band_t, -band, band, color="0.88", lw=0)
        right.axhspan(-2.0 * each.noise, 2.0 * each.noise, color="0.72", lw=0)
        left.set_title(
            f"{each.channel}   ({each.recording}, episode {each.episode})",
            fontsize=9, loc="left",
        )  # fmt: skip
        unit = (units or {}).get(each.channel, "")
        right.set_title(
            f"measured - simulated{f' [{unit}]' if unit else ''}; grey: expected "
            "(2 sigma)",
            fontsize=9,
        )
        right.set_yscale("symlog", linthresh=max(float(np.max(expected)), 1e-12))
        _plain_numbers(right.yaxis)
        for axes in (left, right):
            _plain(axes)
            axes.tick_params(labelsize=8)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]", fontsize=9)
    grid[0, 0].legend(fontsize=8, frameon=False, ncols=3)
    return figure


def stretch(each: Series, most: int = _MOST_WINDOWS) -> Series:
    """At most so many windows, about the one with the largest error: of more nothing is
    seen."""
    n = len(each.time)
    cuts = [0, *sorted({int(s) for s in each.starts if 0 < s < n}), n]
    if len(cuts) - 1 <= most:
        return each
    error = np.nan_to_num((each.measured - each.before) ** 2)
    sizes = [error[a:b].mean() for a, b in pairwise(cuts)]
    first = int(np.argmax(sizes)) - most // 2
    first = min(max(first, 0), len(sizes) - most)
    a, b = cuts[first], cuts[first + most]
    starts = np.array([s - a for s in cuts if a <= s < b])
    parts = (each.time, each.measured, each.before, each.after)
    time, measured, before, after = (part[a:b] for part in parts)
    return replace(
        each, time=time, measured=measured, before=before, after=after, starts=starts,
        expected=expected_of(each)[a:b],
    )  # fmt: skip


def expected_of(each: Series) -> np.ndarray:
    """(n,) of a series, the noise where nothing else is known."""
    if each.expected is None:
        return np.full(len(each.time), each.noise)
    return np.asarray(each.expected)


def picture_of_trust(result: GapResult) -> Figure | None:
    """A strip for each parameter: its value on parts of the data and from other starts,
    in the deviations that such a part should have from what all data say.

    Returns: None if there is none.
    """
    shown = result.trust[:MOST_PARAMETERS]
    if not shown:
        return None
    figure = Figure(
        figsize=(8.0, 1.2 + 0.34 * max(len(shown), 2)), layout="constrained"
    )
    axes = figure.add_subplot()
    axes.axvspan(-2.0, 2.0, color="0.92", lw=0)
    marks = (
        ("stretches", "o", "intervals of time", "#d98032"),
        ("recordings", "D", "recordings", "#2b6cb0"),
        ("starts", "|", "other initial values", "#222222"),
    )
    widest = 3.0
    for row, each in enumerate(shown):
        for name, mark, _, colour in marks:
            values = getattr(each, name)
            values = list(values.values()) if isinstance(values, Mapping) else values
            size = max(each.std, 1e-9 * abs(each.value), 1e-300)
            if name != "starts":  # A part of the data knows less than all.
                size *= max(len(values), 1) ** 0.5
            off = [(v - each.value) / size for v in values if np.isfinite(v)]
            widest = max([widest, *map(abs, off)])
            axes.plot(off, [row] * len(off), mark, color=colour, ms=6, mfc="none")
    for _, mark, label, colour in marks:
        axes.plot([], [], mark, color=colour, mfc="none", label=label)
    names = [f"{t.parameter} of {t.kind} at {', '.join(t.at)}" for t in shown]
    axes.set_yticks(range(len(shown)), names, fontsize=8)
    axes.set_ylim(len(shown) - 0.5, -0.5)
    axes.set_xscale("symlog", linthresh=3.0)
    axes.set_xlim(-1.3 * widest, 1.3 * widest)
    ticks = [-1000, -100, -30, -10, -3, -2, 0, 2, 3, 10, 30, 100, 1000]
    axes.set_xticks([x for x in ticks if abs(x) <= 1.3 * widest])
    _plain_numbers(axes.xaxis)
    axes.set_xlabel(
        "difference in standard deviations (grey: within 2)",
        fontsize=9,
    )
    axes.legend(
        fontsize=8, frameon=False, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0)
    )
    _plain(axes)
    return figure


def _plain_numbers(axis) -> None:
    """1 and 10, not powers of ten, as far as they are short."""
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def broken(t, value, starts):
    """With a break before each window: it starts anew from what was measured."""
    cuts = [int(s) for s in starts if 0 < s < len(t)]
    return np.insert(t, cuts, np.nan), np.insert(value, cuts, np.nan)


def _rms_before(each: Series) -> float:
    error = (each.measured - each.before) / max(each.noise, 1e-300)
    good = np.isfinite(error)
    return float(np.sqrt(np.mean(error[good] ** 2))) if good.any() else 0.0


def _beside(value: float, floor: float) -> float:
    """Where a bar's number begins: not on the line of the noise floor."""
    near = np.isfinite(floor) and 0.3 * floor < value <= 1.1 * floor
    return floor if near else 1e-3


def _finite(value) -> float:
    """0 where there is no number: a bar of no length."""
    return float(value) if value is not None and np.isfinite(value) else 0.0


def _plain(axes) -> None:
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.grid(axis="x", color="0.9", lw=0.8)
    axes.set_axisbelow(True)
