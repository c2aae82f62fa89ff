"""Timing of models that train in turn, and of what their time goes to."""

import re
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_policyflow.benchmark.speed.settings import Setting
from sb3_policyflow.envs.tensor import TensorEnvAdapter

PARTS = ("environment", "sampling", "bootstrap", "other", "update")
"""What an iteration consists of: ``other`` is the rest of a rollout, buffer and loop."""

Seconds = dict[str, float]


class Stopwatch:
    """Adds up the time that some of a model's methods take.

    :param model: The model, whose methods are wrapped.
    """

    def __init__(self, model: OnPolicyAlgorithm) -> None:
        assert model.env is not None
        self._model = model
        self._total: Seconds = {}
        if isinstance(model.env, TensorEnvAdapter):
            self._watch(model.env.env, "step", "environment")
        else:
            self._watch(model.env, "step_wait", "environment")
        self._watch(model.policy, "forward", "sampling")
        self._watch(model.policy, "predict_values", "bootstrap")
        self._watch(model, "train", "update")

    def _watch(self, thing: Any, name: str, part: str) -> None:
        method = getattr(thing, name)

        def watched(*args: Any, **kwargs: Any) -> Any:
            start = now(self._model)
            try:
                return method(*args, **kwargs)
            finally:
                self._total[part] = self._total.get(part, 0.0) + now(self._model) - start

        setattr(thing, name, watched)

    def iteration(self) -> Seconds:
        """Train for one iteration; seconds in all and for each part."""
        self._total.clear()
        model = self._model
        start = now(model)
        model.learn(model.n_steps * model.n_envs, reset_num_timesteps=False, log_interval=1_000_000)
        total = now(model) - start
        known = {part: self._total.get(part, 0.0) for part in PARTS if part != "other"}
        return {"total": total, **known, "other": total - sum(known.values())}


def now(model: OnPolicyAlgorithm) -> float:
    """The time when the device is done with what it was given."""
    if model.device.type == "cuda":
        th.cuda.synchronize()
    return time.perf_counter()


def time_setting(setting: Setting, repetitions: int) -> dict[str, Any]:
    """Train all of a setting's models in turn; medians, ratios, and all measurements.

    Ratios are those of the first to the last. The first iteration of each, which compiles and
    allocates, does not count.
    """
    watches = {name: Stopwatch(make()) for name, make in setting.makers.items()}
    for watch in watches.values():
        watch.iteration()
    taken: dict[str, list[Seconds]] = {name: [] for name in watches}
    for repetition in range(repetitions):
        names = list(watches)
        for name in names if repetition % 2 == 0 else reversed(names):
            taken[name].append(watches[name].iteration())
    medians = {name: _medians(runs) for name, runs in taken.items()}
    first, *_, last = ([run["total"] for run in runs] for runs in taken.values())
    return {
        "title": setting.title,
        "seconds": medians,
        "ratio": statistics.median(first) / statistics.median(last),
        "ratios": [a / b for a, b in zip(first, last, strict=True)],
        "runs": taken,
    }


def _medians(runs: list[Seconds]) -> Seconds:
    return {part: statistics.median(run[part] for run in runs) for part in ("total", *PARTS)}


def time_calls(
    calls: Mapping[str, Callable[[], object]], repetitions: int, n_calls: int = 1000
) -> dict[str, float]:
    """Median seconds of each call, over rounds in which they take turns."""
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repetitions + 1):
        for name, call in calls.items():
            start = time.perf_counter()
            for _ in range(n_calls):
                call()
            taken[name].append((time.perf_counter() - start) / n_calls)
    return {name: statistics.median(rounds[1:]) for name, rounds in taken.items()}


def peak_memory() -> float:
    """The most memory that this process has had, in MiB."""
    status = Path("/proc/self/status")
    if status.is_file():
        # What getrusage says on Linux includes the process that started this one.
        [peak] = re.findall(r"VmHWM:\s+(\d+) kB", status.read_text(encoding="utf-8"))
        return int(peak) / 2**10
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(peak / (2**20 if sys.platform == "darwin" else 2**10))
