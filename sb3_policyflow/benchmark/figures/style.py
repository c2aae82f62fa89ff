"""What the figures have in common.

Figures are Matplotlib's ``Figure``, made without ``pyplot``, so that no global state changes;
``figure.savefig("name.png")`` writes one.
"""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter

from sb3_policyflow.envs.drawing import INK

DPI = 160
GRAY = "#9aa0a8"
PALE = "#d9dce1"
# Okabe and Ito's palette in the order in which it separates best on white.
SERIES_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")


OF_ALGORITHMS = {
    "ppo": ("#E69F00", "s"),
    "policyflow": ("#0072B2", "o"),
    "fpo": ("#D55E00", "^"),
    "dppo": ("#009E73", "D"),
}
"""Color and marker of each algorithm, in every figure."""
OF_VARIANTS = ("#56B4E9", "v"), ("#CC79A7", "P"), ("#999999", "X")
"""Those of other names: variants of an algorithm, such as "policyflow-latent0.3"."""


def series_styles(names: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Color and marker of each name; an algorithm's own are the same in every figure.

    >>> series_styles(["ppo", "policyflow-latent0.3"])["ppo"]
    ('#E69F00', 's')

    :param names: Names of results, in the order of the figure.
    """
    others = [name for name in names if name not in OF_ALGORITHMS]
    free = {name: OF_VARIANTS[i % len(OF_VARIANTS)] for i, name in enumerate(others)}
    return {name: OF_ALGORITHMS.get(name) or free[name] for name in names}


def style_curves(axes: Axes, title: str) -> None:
    """Title, labels and grid of learning curves."""
    axes.set_title(title, fontsize=10, color=INK, loc="left")
    axes.set_xlabel("environment steps", fontsize=9, color=INK)
    axes.set_ylabel("mean episode return", fontsize=9, color=INK)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.tick_params(labelsize=8, colors=INK, length=0)
    axes.grid(axis="y", color=PALE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["left", "top", "right"]].set_visible(False)
    axes.spines["bottom"].set_color(PALE)
    axes.margins(x=0.01)
