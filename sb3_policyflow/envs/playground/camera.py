"""Pictures of simulations that run on JAX, drawn by MuJoCo on the host."""

from typing import Any

import mujoco
import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

HEIGHT, WIDTH = 240, 320


class Camera:
    """Draws single environments of a batch, as the model's first camera sees them.

    OpenGL is needed only once a picture is drawn.

    :param model: MuJoCo's model.
    """

    def __init__(self, model: Any) -> None:
        self._model = model
        self._data = mujoco.MjData(model)
        self._view = 0 if model.ncam else -1
        self._renderer: Any = None

    def picture(self, data: Any, index: int) -> NDArray[np.uint8]:
        """Colors, shape (HEIGHT, WIDTH, 3).

        :param data: The batch's data.
        :param index: Which environment.
        :raises DependencyNotInstalled: If MuJoCo finds no OpenGL to draw with.
        """
        self._renderer = self._renderer or _make_renderer(self._model)
        for field in ("qpos", "qvel", "mocap_pos", "mocap_quat"):
            getattr(self._data, field)[:] = np.asarray(getattr(data, field))[index]
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, self._view)
        pixels: NDArray[np.uint8] = self._renderer.render()
        return pixels

    def close(self) -> None:
        """Free what OpenGL has allocated."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def _make_renderer(model: Any) -> Any:
    try:
        return mujoco.Renderer(model, HEIGHT, WIDTH)
    # Each of MuJoCo's backends fails in its own way.
    except Exception as error:
        raise DependencyNotInstalled(
            f"MuJoCo cannot draw here ({type(error).__name__}: {error}): set MUJOCO_GL=egl in the "
            "environment (glfw with a display, osmesa without a GPU), or do not render."
        ) from error
