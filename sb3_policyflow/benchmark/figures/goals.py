"""Where a policy goes from the center of MultiGoal."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Rectangle

from sb3_policyflow.benchmark.figures.style import DPI, GRAY, PALE
from sb3_policyflow.benchmark.measure.goals import Trajectories, goal_counts, goal_report
from sb3_policyflow.envs.drawing import GOAL_COLORS, INK
from sb3_policyflow.envs.multigoal.point_masses import GOALS, WALL


def draw_trajectories(axes: Axes, trajectories: Trajectories) -> None:
    """Draw the workspace, its goals and each trajectory in the color of the goal it ended at."""
    reached = trajectories.goals()
    palette = np.array([*(to_rgba(color) for color in GOAL_COLORS), to_rgba(GRAY)])
    opacity = float(np.clip(60 / len(reached), 0.12, 0.8))
    for goal in range(-1, len(GOALS)):
        lines = trajectories.positions[reached == goal]
        axes.add_collection(
            LineCollection(
                list(lines),
                colors=[palette[goal]],
                linewidths=0.6,
                alpha=opacity,
                rasterized=True,
            )
        )
    _draw_workspace(axes)


def _draw_workspace(axes: Axes) -> None:
    wall = Rectangle((-WALL, -WALL), 2 * WALL, 2 * WALL, fill=False, edgecolor=PALE, linewidth=1.2)
    axes.add_patch(wall)
    axes.scatter(
        GOALS[:, 0], GOALS[:, 1], s=70, c=GOAL_COLORS, edgecolors="white", linewidths=1.4, zorder=3
    )
    axes.scatter(0, 0, s=16, color=INK, edgecolors="white", linewidths=0.8, zorder=3)
    axes.set(xlim=(-WALL - 0.3, WALL + 0.3), ylim=(-WALL - 0.3, WALL + 0.3), aspect="equal")
    axes.axis("off")


def draw_goal_counts(axes: Axes, trajectories: Trajectories, top: float | None = None) -> None:
    """Draw a bar for each goal's number of trajectories, in its color; dashed: all alike.

    :param axes: Where to draw.
    :param trajectories: The trajectories.
    :param top: Where the axis ends, to compare panels; by default at the highest bar.
    """
    report = goal_report(trajectories)
    n = len(trajectories.lengths)
    places = range(len(GOALS))
    axes.bar(places, report.counts, color=GOAL_COLORS, width=0.72)
    axes.set_xticks(places, [str(count) for count in report.counts])
    axes.tick_params(length=0, labelsize=7.5, labelcolor=INK, pad=2)
    axes.axhline(n / len(GOALS), color=GRAY, linewidth=0.8, linestyle=(0, (4, 3)), zorder=0)
    axes.set(ylim=(0, top or 1.08 * max(n / len(GOALS), *report.counts)), yticks=[])
    axes.spines[["left", "top", "right"]].set_visible(False)
    axes.spines["bottom"].set_color(PALE)
    axes.set_xlabel(
        f"entropy {report.entropy:.2f}   return {report.mean_return:.1f}   "
        f"no goal {report.share_missed:.1%}",
        fontsize=8,
        color=INK,
    )


def goals_figure(runs: Mapping[str, Trajectories], n_columns: int = 3) -> Figure:
    """A panel for each run: its trajectories, and below them the counts, entropy and return.

    :param runs: Trajectories by the panel's title.
    :param n_columns: Panels side by side.
    """
    n_columns = min(n_columns, len(runs))
    n_rows = -(-len(runs) // n_columns)
    figure = Figure(figsize=(3.1 * n_columns, 4.05 * n_rows + 0.3), dpi=DPI, layout="constrained")
    figure.supxlabel(
        "Gray: at no goal. Bars: trajectories that end"
        f"{chr(10) if n_columns == 1 else ' '}at each goal; dashed: all goals alike.",
        fontsize=8,
        color=INK,
    )
    # One scale of bars for all panels.
    counts = [max(goal_counts(t).max(), len(t.lengths) / len(GOALS)) for t in runs.values()]
    top = 1.08 * float(max(counts))
    panels = np.ravel(figure.subfigures(n_rows, n_columns, squeeze=False))
    for panel, (title, trajectories) in zip(panels, runs.items(), strict=False):
        _draw_panel(panel, title, trajectories, top)
    return figure


def _draw_panel(panel: SubFigure, title: str, trajectories: Trajectories, top: float) -> None:
    upper, lower = panel.subplots(2, 1, height_ratios=[5, 1])
    draw_trajectories(upper, trajectories)
    draw_goal_counts(lower, trajectories, top)
    upper.set_title(title, fontsize=10, color=INK)
