"""Anti-aliased lines and discs on an RGB array, and the environments' pictures made of them.

NumPy is enough for this, so that the environments need no dependency to draw: pygame, with which
Gymnasium draws its own, is an optional extra.
"""

from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_policyflow.envs.type_aliases import FloatArray

Color = tuple[float, float, float]

# Okabe and Ito's palette, told apart by color-blind readers too; one color for each goal.
GOAL_COLORS: tuple[Color, ...] = (
    (0.00, 0.45, 0.70),
    (0.90, 0.62, 0.00),
    (0.00, 0.62, 0.45),
    (0.80, 0.47, 0.65),
    (0.84, 0.37, 0.00),
    (0.34, 0.71, 0.91),
)
INK: Color = (0.13, 0.15, 0.19)
MARGIN: Color = (0.88, 0.89, 0.91)


class Canvas:
    """A square picture of the plane's region ``|x|, |y| <= half_width``, y upwards.

    :param size: Width and height in pixels.
    :param half_width: Half the width of the region, in the plane's units.
    """

    def __init__(self, size: int, half_width: float) -> None:
        self.half_width = half_width
        self.scale = size / (2 * half_width)
        self.image: FloatArray = np.ones((size, size, 3))

    def pixel(self, point: ArrayLike) -> FloatArray:
        """Column and row of a point of the plane, pixel centers at whole numbers."""
        x, y = np.asarray(point, dtype=np.float64)
        return np.array([x + self.half_width, self.half_width - y]) * self.scale - 0.5

    def centers(self) -> FloatArray:
        """The plane's points at the pixel centers, shape (size, size, 2)."""
        along = (np.arange(len(self.image)) + 0.5) / self.scale - self.half_width
        return np.stack(np.meshgrid(along, -along), axis=-1)

    def line(
        self,
        start: ArrayLike,
        end: ArrayLike,
        width: float,
        color: Color,
        opacity: float = 1.0,
    ) -> None:
        """Draw a line with round ends.

        A pixel is covered by ``clip(width / 2 - distance to the segment + 1/2, 0, 1)``, in pixels.

        :param start: The segment's first point.
        :param end: Its last point; the same as ``start`` draws a disc.
        :param width: In the plane's units.
        :param color: Red, green and blue in [0, 1].
        :param opacity: In [0, 1].
        """
        first, last = self.pixel(start), self.pixel(end)
        reach = width * self.scale / 2 + 0.5
        low = np.floor(np.minimum(first, last) - reach).astype(int).clip(0)
        high = np.ceil(np.maximum(first, last) + reach).astype(int) + 1
        window = self.image[low[1] : high[1].clip(0), low[0] : high[0].clip(0)]
        rows, columns = np.ogrid[: window.shape[0], : window.shape[1]]
        distance = _distance_to_segment(columns + low[0], rows + low[1], first, last)
        cover = opacity * (reach - distance).clip(0, 1)[..., None]
        window += cover * (np.array(color) - window)

    def disc(self, center: ArrayLike, radius: float, color: Color, opacity: float = 1.0) -> None:
        """Draw a filled circle; the arguments are those of ``line``."""
        self.line(center, center, 2 * radius, color, opacity)

    def to_uint8(self) -> NDArray[np.uint8]:
        """The picture as bytes, shape (size, size, 3)."""
        return (self.image * 255 + 0.5).astype(np.uint8)


def _distance_to_segment(
    x: NDArray[np.int_], y: NDArray[np.int_], start: FloatArray, end: FloatArray
) -> FloatArray:
    along = end - start
    dx, dy = x - start[0], y - start[1]
    share = ((dx * along[0] + dy * along[1]) / max(float(along @ along), 1e-12)).clip(0, 1)
    distance: FloatArray = np.hypot(dx - share * along[0], dy - share * along[1])
    return distance


def draw_multigoal(
    goals: FloatArray, wall: float, trail: FloatArray, size: int
) -> NDArray[np.uint8]:
    """The workspace, its goals and the path of one episode, shape (size, size, 3).

    :param goals: Shape (n_goals, 2).
    :param wall: The workspace is ``|x|, |y| <= wall``.
    :param trail: The positions so far, oldest first, shape (n, 2).
    :param size: Width and height in pixels.
    """
    canvas = Canvas(size, half_width=wall * 1.06)
    canvas.image = _workspace(tuple(map(tuple, goals.tolist())), wall, size).copy()
    _draw_trail(canvas, trail, width=0.12)
    return canvas.to_uint8()


def draw_maze(
    free: NDArray[np.bool_], goals: FloatArray, trail: FloatArray, size: int
) -> NDArray[np.uint8]:
    """A square maze from above, its goals and the path of one episode.

    :param free: Whether each cell is free, rows from the top, shape (n, n).
    :param goals: Shape (n_goals, 2), the maze's cells having side 1 and its center the origin.
    :param trail: The positions so far, oldest first, shape (n_positions, 2).
    :param size: Width and height in pixels.
    """
    canvas = Canvas(size, half_width=len(free) / 2)
    cell = np.arange(size) * len(free) // size
    canvas.image[~free[np.ix_(cell, cell)]] = MARGIN
    for goal in goals:
        canvas.disc(goal, 0.2, GOAL_COLORS[4])
    _draw_trail(canvas, trail, width=0.06)
    return canvas.to_uint8()


def _draw_trail(canvas: Canvas, trail: FloatArray, width: float) -> None:
    """A line that darkens towards the present, from a small disc to a large one."""
    for age, (start, end) in enumerate(pairwise(trail), start=1):
        canvas.line(start, end, width, _faded(INK, 0.2 + 0.8 * age / len(trail)))
    canvas.disc(trail[0], 1.2 * width, _faded(INK, 0.4))
    canvas.disc(trail[-1], 2.5 * width, (1.0, 1.0, 1.0))
    canvas.disc(trail[-1], 1.9 * width, INK)


def _faded(color: Color, strength: float) -> Color:
    red, green, blue = (1 - strength * (1 - part) for part in color)
    return red, green, blue


@lru_cache(maxsize=4)
def _workspace(goals: tuple[tuple[float, float], ...], wall: float, size: int) -> FloatArray:
    """What all frames share: each goal's glow (as wide as its reward), the goals, the walls."""
    canvas = Canvas(size, half_width=wall * 1.06)
    points = canvas.centers()
    squared = np.square(points[:, :, None] - np.array(goals)).sum(axis=-1)
    colors = np.array([GOAL_COLORS[i % len(GOAL_COLORS)] for i in range(len(goals))])
    glow = 0.30 * np.exp(-0.2 * squared)[..., None] * (1 - colors)
    canvas.image = (1 - glow.sum(axis=2)).clip(0, 1)
    canvas.image[np.abs(points).max(axis=-1) > wall] = MARGIN
    for goal, color in zip(goals, colors.tolist(), strict=True):
        canvas.disc(goal, 0.42, (1.0, 1.0, 1.0))
        canvas.disc(goal, 0.34, color)
    return canvas.image
