"""The learning curve of one training, from the log of SB3's logger."""

from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from sb3_policyflow.benchmark.errors import BenchmarkError
from sb3_policyflow.benchmark.figures.style import DPI, SERIES_COLORS, style_curves


def progress_figure(path: Path, title: str = "") -> Figure:
    """Mean episode return over environment steps.

    :param path: SB3's ``progress.csv``.
    :param title: Above the axes.
    :raises BenchmarkError: If no episode had ended when the log was last written.
    """
    log = pd.read_csv(path)
    if "rollout/ep_rew_mean" not in log:
        raise BenchmarkError(f"There is no finished episode in {path}: train for more steps.")
    log = log.dropna(subset=["rollout/ep_rew_mean"])
    figure = Figure(figsize=(5.6, 3.5), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    steps, returns = log["time/total_timesteps"], log["rollout/ep_rew_mean"]
    axes.plot(steps.to_numpy(), returns.to_numpy(), color=SERIES_COLORS[0], linewidth=1.8)
    style_curves(axes, title)
    return figure
