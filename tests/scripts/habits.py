"""What users do around a run, for ``fuzz.py``: wrappers, changed attributes, and other threads."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium import spaces
from hypothesis import strategies as st
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecMonitor, VecNormalize

KINDS = [np.float16, np.float32, np.float64, np.int64]
habits: st.SearchStrategy[dict[str, Any]] = st.fixed_dictionaries(
    {
        "overrides": st.sampled_from([None, "step", "step_async", "step_wait"]),
        "wrappers": st.lists(st.sampled_from(["normalize", "monitor"]), max_size=2, unique=True),
        "rewards": st.sampled_from(KINDS),
        "dones": st.sampled_from([np.bool_, np.uint8, np.float32]),
        "infos": st.sampled_from([list, tuple]),
        "read_only": st.booleans(),
        "asks": st.sampled_from([False, False, False, True]),
    }
)


class Cast(VecEnvWrapper):
    """Returns rewards, ends and infos of other kinds, and looks whether rewards are left alone."""

    touched = False
    kept: tuple[np.ndarray, np.ndarray] | None = None

    def __init__(self, venv: VecEnv, drawn: dict[str, Any]) -> None:
        super().__init__(venv)
        self.drawn = drawn

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        obs, rewards, dones, infos = self.venv.step_wait()
        self.look()
        rewards = np.nan_to_num(rewards).astype(self.drawn["rewards"])
        self.kept = rewards, rewards.copy()
        rewards.flags.writeable = not self.drawn["read_only"]
        return obs, rewards, dones.astype(self.drawn["dones"]), self.drawn["infos"](infos)

    def look(self) -> None:
        self.touched |= self.kept is not None and not np.array_equal(*self.kept, equal_nan=True)


def counting(overrides: str) -> type[VecEnvWrapper]:
    """A wrapper that counts steps in the method that it overrides."""

    def step(self: Any, actions: np.ndarray) -> Any:
        self.n_steps += 1
        return self.venv.step(actions)

    def step_async(self: Any, actions: np.ndarray) -> None:
        self.n_steps += 1
        self.kept = actions
        if overrides == "step_async":
            self.venv.step_async(actions)

    def step_wait(self: Any) -> Any:
        return self.venv.step(self.kept) if overrides == "step_wait" else self.venv.step_wait()

    methods: dict[str, Any] = {"reset": lambda self: self.venv.reset(), "step_wait": step_wait}
    methods |= {"step": step} if overrides == "step" else {"step_async": step_async}
    return type("Counting", (VecEnvWrapper,), {"n_steps": 0, **methods})


def wrap(env: VecEnv, drawn: dict[str, Any]) -> VecEnv:
    """An environment in the wrappers that were drawn; the one that counts is the outermost."""
    space = env.observation_space
    is_numbers = isinstance(space, spaces.Box) and space.dtype != np.uint8
    for name in drawn["wrappers"]:
        env = VecMonitor(env) if name == "monitor" else VecNormalize(env, norm_obs=is_numbers)
    env = Cast(env, drawn)
    return counting(drawn["overrides"])(env) if drawn["overrides"] else env


class Watch(BaseCallback):
    """Keeps what it sees, and changes attributes after the first rollout.

    :param changes: Values of attributes by name.
    """

    def __init__(self, changes: dict[str, Any]) -> None:
        super().__init__()
        self.changes = changes
        self.kept: list[tuple[str, Any, Any]] = []
        self.refusals: list[Exception] = []

    def _on_step(self) -> bool:
        for name in ("rewards", "dones", "infos", "new_obs", "clipped_actions"):
            value = self.locals[name]
            self.kept.append((name, value, deepcopy(value)))
        return True

    def _on_rollout_end(self) -> None:
        changes, self.changes = self.changes, {}
        for name, value in changes.items():
            self._change(name, value)

    def _change(self, name: str, value: Any) -> None:
        try:
            setattr(self.model, name, value)
        except (ValueError, AttributeError) as refusal:
            self.refusals.append(refusal)

    def check(self) -> None:
        """Whether all of it is as it was, and the environment's wrappers were used.

        :raises AssertionError: If not.
        """
        for name, value, copy in self.kept:
            np.testing.assert_equal(value, copy, err_msg=f"{name} changed after it was seen")
        env: Any = self.model.get_env()
        n_steps = env.n_steps if type(env).__name__ == "Counting" else self.n_calls
        assert n_steps == self.n_calls, f"the wrapper's step was called {n_steps} times"
        cast = env.venv if type(env).__name__ == "Counting" else env
        cast.look()
        assert not cast.touched, "rewards of the environment were changed"


@contextmanager
def asked(model: Any, observation: Any, asks: bool) -> Iterator[None]:
    """A block during which another thread asks the model for actions, if that was drawn."""
    is_done, errors = threading.Event(), list[Exception]()

    def ask() -> None:
        try:
            while not is_done.is_set():
                action, _ = model.predict(observation)
                assert np.isfinite(action).all()
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=ask)
    if asks:
        thread.start()
    try:
        yield
    finally:
        is_done.set()
        if asks:
            thread.join()
    if errors:
        raise RuntimeError("predict failed in another thread") from errors[0]
