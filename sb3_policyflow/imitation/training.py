"""The loop of cloning: minibatches, validation, the best parameters, and its state in a file."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import update_learning_rate

from sb3_policyflow.common.optimization import clip_gradients, make_optimizer
from sb3_policyflow.common.policies import FlowPolicy
from sb3_policyflow.common.schedules import parse_schedule
from sb3_policyflow.imitation.options import CloningOptions
from sb3_policyflow.imitation.samples import CloningSamples
from sb3_policyflow.resilience.files import atomic_write
from sb3_policyflow.resilience.saving import RandomStates, preserve_rng_state

PLAIN = (bool, int, float, str, tuple, type(None))
"""Types of a policy's options that are compared when a cloning continues."""


class CloningRun:
    """One cloning, from its first step or from where an interrupted one has stopped.

    :param model: The model.
    :param samples: The demonstrations.
    :param options: How to clone.
    """

    def __init__(self, model: Any, samples: CloningSamples, options: CloningOptions) -> None:
        self._model, self._samples, self._options = model, samples, options
        self._policy = model.policy
        self._rate = parse_schedule("learning_rate", options.learning_rate)
        groups = self._policy.optimizer.param_groups
        self._parameters = [parameter for group in groups for parameter in group["params"]]
        self._optimizer = make_optimizer(
            self._policy.optimizer_class, self._parameters, 1e-3, self._policy.optimizer_kwargs
        )
        self._order = np.empty(0, dtype=np.int64)
        self._losses: list[float] = []
        self.step = 0
        self.best_loss, self.best_step = math.inf, 0
        self._best = deepcopy(self._policy.state_dict())

    def train(self, callback: BaseCallback, progress_bar: bool = False) -> None:
        """Take all steps, and leave the policy with its best parameters.

        :param callback: What is asked after each step.
        :param progress_bar: Whether to show a progress bar.
        """
        options = self._options
        with preserve_rng_state(self._model.device), _bar(options, progress_bar) as advance:
            self._seed()
            self._train, self._held = self._samples.split(options.validation_fraction)
            self._validation_states = RandomStates.now(self._model.device)
            self._resume()
            self._samples.take_up_statistics()  # not before what may refuse the cloning
            advance(self.step)
            while self.step < options.gradient_steps and not self._is_stuck():
                self._take_step()
                advance(1)
                if self.step % options.eval_freq == 0 or self.step == options.gradient_steps:
                    self._validate()
                    self._write()
                if not callback.on_step():
                    break
            if self._losses:  # of steps since the last validation: a callback has stopped it
                self._validate()
        self._policy.load_state_dict(self._best)
        self._policy.set_training_mode(False)
        if options.checkpoint is not None:
            Path(options.checkpoint).unlink(missing_ok=True)

    def _seed(self) -> None:
        seed = self._options.seed if self._options.seed is not None else self._model.seed
        if seed is not None:
            th.manual_seed(seed)
            np.random.seed(seed)

    def _is_stuck(self) -> bool:
        patience, waited = self._options.patience, self.step - self.best_step
        has_validation = len(self._held) > 0
        return (
            has_validation and patience is not None and waited >= patience * self._options.eval_freq
        )

    def _take_step(self) -> None:
        update_learning_rate(
            self._optimizer, self._rate(1 - self.step / self._options.gradient_steps)
        )
        self._policy.set_training_mode(True)
        loss = self._losses_of(self._next_batch()).mean()
        for parameter in self._parameters:
            parameter.grad = None
        th.autograd.backward(loss)
        norm = clip_gradients(self._parameters, self._model.max_grad_norm)
        if not (math.isfinite(loss.item()) and math.isfinite(norm)):
            raise FloatingPointError(
                f"The loss of cloning is not finite after {self.step} steps: look for numbers that "
                "are not finite among the observations, or lower the learning rate."
            )
        self._optimizer.step()
        if isinstance(self._policy, FlowPolicy):
            self._policy.keep_within_bounds()
        self._losses.append(loss.item())
        self.step += 1

    def _losses_of(self, transitions: np.ndarray) -> th.Tensor:
        """The losses of transitions, given by their indices, shape (n,)."""
        observations, actions = self._samples.batch(transitions)
        policy = self._policy
        if isinstance(policy, FlowPolicy):
            return policy.cloning_losses(policy.actor_features(observations), actions.flatten(1))
        log_prob: th.Tensor = policy.evaluate_actions(observations, actions)[1]
        return -log_prob

    def _next_batch(self) -> np.ndarray:
        """The next transitions of a random order, in which each occurs before any does twice."""
        size = min(self._options.batch_size, len(self._train))
        if len(self._order) < size:
            self._order = np.random.permutation(self._train)
        batch, self._order = self._order[:size], self._order[size:]
        return batch

    def _validate(self) -> None:
        """Measure the loss of what is held out, remember the best parameters, and log both."""
        loss = np.mean(self._losses) if len(self._held) == 0 else self._validation_loss()
        if len(self._held) == 0 or loss < self.best_loss:
            self.best_loss, self.best_step = float(loss), self.step
            self._best = deepcopy(self._policy.state_dict())
        values = {
            "loss": float(np.mean(self._losses)),
            "learning_rate": self._optimizer.param_groups[0]["lr"],
            "gradient_steps": self.step,
        }
        if len(self._held) > 0:
            values |= {"validation_loss": float(loss), "best_validation_loss": self.best_loss}
        for name, value in values.items():
            self._model.logger.record(f"imitation/{name}", value)
        self._model.logger.dump(self.step)
        self._losses = []

    def _validation_loss(self) -> float:
        """The mean loss of what is held out, with the same draws in every validation."""
        device, size = self._model.device, self._options.batch_size
        self._policy.set_training_mode(False)
        total = 0.0
        with preserve_rng_state(device), th.no_grad():
            self._validation_states.restore(device)
            for start in range(0, len(self._held), size):
                total += self._losses_of(self._held[start : start + size]).sum().item()
        return total / len(self._held)

    # The state of a run in its file

    @cached_property
    def _settings(self) -> dict[str, Any]:
        """What this run must have in common with the one that it continues."""
        made_with = self._policy._get_constructor_parameters()
        return {
            **self._options.settings(),
            "demonstrations": self._samples.digest(),
            "policy": type(self._policy).__name__,
            "policy_kwargs": {k: v for k, v in made_with.items() if isinstance(v, PLAIN)},
            "parameters": {name: list(v.shape) for name, v in self._policy.state_dict().items()},
        }

    def _write(self) -> None:
        if self._options.checkpoint is None:
            return
        state = {
            "settings": self._settings,
            "policy": self._policy.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "best": (self._best, self.best_loss, self.best_step),
            "step": self.step,
            "order": self._order,
            "split": (self._train, self._held),
            "random": (RandomStates.now(self._model.device), self._validation_states),
        }
        with atomic_write(self._options.checkpoint) as file:
            th.save(state, file)

    def _resume(self) -> None:
        """Continue from the file, if there is one.

        :raises ValueError: If another cloning wrote it, or no cloning at all.
        """
        path = self._options.checkpoint
        if path is None or not Path(path).is_file():
            return
        state = _read(path)
        if state.get("settings") != self._settings:
            raise ValueError(
                f"{path} is not the state of a cloning with these options, demonstrations and "
                "networks: name another checkpoint, or delete it."
            )
        self._policy.load_state_dict(state["policy"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._best, self.best_loss, self.best_step = state["best"]
        self.step, self._order = state["step"], state["order"]
        self._train, self._held = state["split"]
        states, self._validation_states = state["random"]
        states.restore(self._model.device)


def _read(path: str | Path) -> dict[str, Any]:
    """The state in a file; an empty one if the file is of another kind, or cannot be read."""
    try:
        # The states of random generators belong on the CPU, and the others find their device.
        state = th.load(path, map_location="cpu", weights_only=False)
    except Exception:  # a pickle may raise anything
        return {}
    return state if isinstance(state, dict) else {}


@contextmanager
def _bar(options: CloningOptions, is_shown: bool) -> Iterator[Callable[[int], object]]:
    """What is told how many steps have been taken, and shows a progress bar if wanted.

    :raises ImportError: If it is to be shown, and tqdm is not installed.
    """
    if not is_shown:
        yield lambda _: None
        return
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise ImportError("progress_bar=True needs tqdm: pip install tqdm.") from error
    with tqdm(total=options.gradient_steps, unit="step") as bar:
        yield bar.update
