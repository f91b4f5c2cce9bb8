"""PNG charts of the results, one file a suite."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rows import Row


def missing() -> str:
    """Why there can be no charts; empty where there can."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        return f"matplotlib cannot be imported ({error})"
    return ""


def draw(folder: Path, rows: Sequence[Row], machine: dict[str, Any]) -> dict[str, list[str]]:
    """Draw every suite that has rows.

    Args:
        folder: where to put the files.
        rows: the results.
        machine: from `machine.describe`, for the line at the foot of each chart.

    Returns:
        File names by suite.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    import charts_bars
    import charts_device
    import charts_invariance
    import charts_price
    import charts_scaling

    drawings: dict[str, Callable[[Sequence[Row]], Any]] = {
        "layers": charts_price.layers,
        "channels": charts_price.channels,
        "grouped": charts_price.grouped,
        "pools": charts_price.pools,
        "dtypes": charts_bars.dtypes,
        "levels": charts_scaling.levels,
        "peers": charts_bars.peers,
        "conv3d": charts_bars.peers,
        "scaling": charts_scaling.scaling,
        "memory": charts_bars.memory,
        "net": charts_bars.net,
        "invariance": charts_invariance.invariance_chart,
        "gpu_layers": charts_device.layers,
        "gpu_memory": charts_device.memory,
        "gpu_net": charts_device.net,
        "gpu_conv3d": charts_bars.peers,
    }
    names: dict[str, list[str]] = {}
    for suite, drawing in drawings.items():
        own = [row for row in rows if row.suite == suite]
        if not own:
            continue
        figure = drawing(own)
        figure.text(0.995, 0.004, _foot(machine), ha="right", va="bottom", fontsize=7, color="0.4")
        figure.savefig(folder / f"{suite}.png", dpi=110)
        pyplot.close(figure)
        names[suite] = [f"{suite}.png"]
    return names


def _foot(machine: dict[str, Any]) -> str:
    where = f"{machine['cpu']}, {machine['surfconv_cpu_capability']}"
    if "gpu" in machine:
        where = f"{machine['gpu']}, cuDNN {machine['cudnn']}, Triton {machine['triton']}"
    return f"{where}, torch {machine['torch']}, commit {machine['commit']}"
