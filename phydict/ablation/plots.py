"""Plots of an ablation: seconds against error, error against views, by geometry, Extra Compute, shares of the time."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from phydict.ablation.summary import (
    SHOWN_MEASURES,
    Entry,
    alike,
    best_settings,
    compared_geometries,
    compared_views,
    conditions,
    deltas,
)
from phydict.inference.conditions import format_settings
from phydict.runtime.files import atomic_write

COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22", "#17becf",
           "#005f40", "#b15928", "#6a3d9a", "#ff1493")
MARKERS = "osD^v<>pP*Xhd"
LINES, FILLS = ("-", "--", "-.", ":"), ("full", "none", "left", "right", "top", "bottom")
KINDS = ("pareto", "stages", "views", "geometry", "delta")
"""What the names of plots begin with."""

WRITER = {"Software": "phydict"}
"""What a plot's file says of who wrote it."""

STAGES = {"seconds_network": "network", "seconds_projector": "projector", "rest": "the rest"}


def _literal(text: str) -> str:
    """A text that Matplotlib shows as it is, whatever dollars are in it."""
    return text.replace("$", "\\$")


def write_plots(folder: Path, entries: Sequence[Entry]) -> list[Path]:
    """Every plot that the entries of the same cases allow, as PNG in a folder, in place of earlier ones, which stay
    where there is none since cases failed; returns the files."""
    written, style = [], styles(entries)
    for condition, of in conditions(entries):
        where, group = format_settings(condition), alike(of)
        if len(group) > 1 and "geometry" not in condition:
            written += [_draw(folder, f"pareto {where}", group, 2, lambda axes: _pareto(axes, group, where, style)),
                        _draw(folder, f"stages {where}", group, 1, lambda axes: _stages(axes[0], group, where))]
    for name, compared, draw in (("views", compared_views, _views), ("geometry", compared_geometries, _geometries)):
        for _, of in compared(entries):
            for rest, group in compared(alike(of)):
                written.append(_draw(folder, f"{name} {format_settings(rest)}", group, 2,
                                     lambda axes: draw(axes, group, style)))
    curves = [(label, group) for label, group in deltas(alike(entries)) if len(group) > 1]
    if curves:
        written.append(_draw(folder, "delta", curves[0][1], 2, lambda axes: _deltas(axes, curves)))
    if written or all(entry.complete for entry in entries):
        for path in folder.glob("*.png"):
            if path.stem.partition("_")[0] in KINDS and path not in written and _is_own(path):
                path.unlink()
    return written


def _is_own(path: Path) -> bool:
    """Whether a picture is a plot that this command wrote."""
    try:
        with Image.open(path) as image:
            return image.info.get("Software") == WRITER["Software"]
    except OSError:  # no picture
        return False


def styles(entries: Sequence[Entry]) -> dict[str, dict]:
    """A colour and a marker for each method, the same in every plot."""
    return {method: {"color": COLOURS[i % len(COLOURS)], "marker": MARKERS[i % len(MARKERS)]}
            for i, method in enumerate(dict.fromkeys(entry.method for entry in entries))}


def setting_styles(entries: Sequence[Entry], style: dict[str, dict]) -> dict[str, dict]:
    """A style for each method with its settings: its method's, each setting's line and marker's filling its own."""
    found: dict[str, dict] = {}
    for method in dict.fromkeys(entry.method for entry in entries):
        names = dict.fromkeys(entry.name for entry in entries if entry.method == method)
        found |= {name: style[method] | {"linestyle": LINES[i % len(LINES)], "fillstyle": FILLS[i % len(FILLS)]}
                  for i, name in enumerate(names)}
    return found


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Of points (cost, gain) those that none beats, in order of cost: no other costs at most as much and gains at
    least as much, one of both strictly."""
    kept, best = [], -math.inf
    for i in sorted(range(len(points)), key=lambda i: (points[i][0], -points[i][1])):
        if points[i][1] > best:
            kept.append(i)
            best = points[i][1]
    return kept


def _draw(folder: Path, name: str, group: Sequence[Entry], panels: int,
          draw: Callable[[Sequence[Axes]], None]) -> Path:
    figure = Figure(figsize=(5.5 * panels + 2.5, 4.8), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, panels, squeeze=False)[0]
    draw(axes)
    if lacking := group[0].lacking:
        figure.suptitle(lacking.strip(), fontsize=9)
    if not axes[-1].get_legend():
        axes[-1].legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    path = folder / (re.sub(r"[^\w.-]+", "_", name.strip()) + ".png")
    with atomic_write(path) as part:
        figure.savefig(part, format="png", metadata=WRITER)
    return path


def _pareto(axes: Sequence[Axes], group: Sequence[Entry], where: str, style: dict) -> None:
    """Seconds against PSNR and SSIM; the settings of a method are joined, and the front is dashed."""
    for ax, name in zip(axes, ("psnr", "ssim")):
        for method in dict.fromkeys(entry.method for entry in group):
            points = sorted((e.means["seconds"], e.means[name]) for e in group if e.method == method)
            ax.plot(*zip(*points), **style[method], linewidth=0.8, markersize=6, label=_literal(method))
        points = [(e.means["seconds"], e.means[name]) for e in group]
        best = [points[i] for i in front(points)]
        ax.plot(*zip(*best), color="black", linestyle="--", linewidth=1, zorder=0, label="front")
        for i in front(points):
            ax.annotate(_literal(group[i].label), points[i], xytext=(4, 4), textcoords="offset points", fontsize=7)
        ax.set_xscale("log")
        _dress(ax, "seconds per case", SHOWN_MEASURES[name].heading)
        ax.set_title(_literal(where), fontsize=9)


def _views(axes: Sequence[Axes], group: Sequence[Entry], style: dict) -> None:
    for ax, name in zip(axes, ("psnr", "ssim")):
        for label, look in setting_styles(group, style).items():
            points = sorted((e.condition["views"], e.means[name]) for e in group if e.name == label)
            ax.plot(*zip(*points), **look, markersize=5, label=_literal(label))
        views = sorted({e.condition["views"] for e in group})
        ax.set_xscale("log", base=2)
        ax.set_xticks(views, map(str, views))
        _dress(ax, "views", SHOWN_MEASURES[name].heading)


def _geometries(axes: Sequence[Axes], group: Sequence[Entry], style: dict) -> None:
    """Where each method stands, a line of the plot for each geometry."""
    places = list(dict.fromkeys(entry.condition["geometry"] for entry in group))
    for ax, name in zip(axes, ("psnr", "ssim")):
        for label, look in setting_styles(group, style).items():
            points = [(entry.means[name], places.index(entry.condition["geometry"])) for entry in group
                      if entry.name == label]
            ax.plot(*zip(*points), **look | {"linestyle": ""}, markersize=6, label=_literal(label))
        ax.set_yticks(range(len(places)), [_literal(Path(place).stem) for place in places])
        ax.invert_yaxis()
        _dress(ax, SHOWN_MEASURES[name].heading, "")


def _deltas(axes: Sequence[Axes], curves: Sequence[tuple[str, list[Entry]]]) -> None:
    """SSIM and, beside it, the misfit of the X-rays."""
    for ax, name in zip(axes, ("ssim", "misfit")):
        for i, (label, group) in enumerate(curves):
            points = [(e.settings["delta"], e.means[name]) for e in group]
            ax.plot(*zip(*points), color=COLOURS[i % len(COLOURS)], marker="o", markersize=5, label=_literal(label))
        _dress(ax, "delta of Extra Compute (0: none)", SHOWN_MEASURES[name].heading)
    axes[-1].set_yscale("log")


def _stages(ax: Axes, group: Sequence[Entry], where: str) -> None:
    """Stacked shares of the seconds, a bar for each method at its best setting, with the seconds in all."""
    best = sorted(best_settings(group), key=lambda entry: entry.means["seconds"])
    labels, left = [_literal(entry.label) for entry in best], [0.0] * len(best)
    for stage, label in STAGES.items():
        shares = []
        for entry in best:
            known = {name: entry.means.get(name, 0.0) for name in STAGES if name != "rest"}
            known["rest"] = max(0.0, entry.means["seconds"] - sum(known.values()))
            shares.append(100 * known[stage] / entry.means["seconds"])
        ax.barh(labels, shares, left=left, label=label)
        left = [a + b for a, b in zip(left, shares)]
    for i, entry in enumerate(best):
        ax.annotate(f"{entry.means['seconds']:.3g} s", (100, i), xytext=(4, -3), textcoords="offset points", fontsize=7)
    ax.set_xlim(0, 115)
    ax.set_axisbelow(True)
    _dress(ax, "share of the time (%)", "")
    ax.set_title(_literal(where), fontsize=9)
    ax.legend(fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1.06), ncols=3)


def _dress(ax: Axes, x: str, y: str) -> None:
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    ax.grid(True, linewidth=0.3)
    ax.tick_params(labelsize=8)
