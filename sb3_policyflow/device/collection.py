"""SB3's loop of a rollout, with tensors on one device in place of arrays and dictionaries."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow.device.normalization import TensorNormalizer
from sb3_policyflow.envs.tensor import (
    LazyInfos,
    TensorEnvAdapter,
    TensorStep,
    map_observations,
)
from sb3_policyflow.resilience.collection import ADVICE
from sb3_policyflow.resilience.finite import all_finite, check_finite


class DeviceCollection:
    """One rollout of an environment of tensors.

    Calls what SB3's loop calls, in its order. Callbacks find the loop's variables in ``locals``
    under SB3's names, as tensors; ``infos`` makes a dictionary only when it is asked for one.
    Numbers that are not finite are found at the end of the rollout.

    :param model: The algorithm.
    :param env: The environment.
    :param normalize: The wrapper around it, or None.
    :param callback: All callbacks.
    :param buffer: Gets the rollout, as tensors.
    """

    def __init__(
        self,
        model: Any,
        env: TensorEnvAdapter,
        normalize: VecNormalize | None,
        callback: BaseCallback,
        buffer: RolloutBuffer,
    ) -> None:
        self.model, self.env, self.callback, self.buffer = model, env, callback, buffer
        self.device = th.device(env.env.device)
        if self.device.type != model.device.type:
            raise ValueError(
                f"The environment is on {self.device} and the model on {model.device}: make one of "
                "them with the other's device."
            )
        self.normalizer = TensorNormalizer(normalize, self.device)
        self.first_timestep: int = model.num_timesteps
        self._stored: dict[str, th.Tensor] = {}
        self._rows: dict[str, list[th.Tensor]] = {}
        self._increments = th.ones_like(env.episodes)
        self._ended: list[tuple[th.Tensor, th.Tensor, th.Tensor | None]] = []
        self._last: TensorStep
        space = model.action_space
        self._bounds = [
            th.as_tensor(bound, device=self.device) for bound in (space.low, space.high)
        ]

    def run(self, n_steps: int) -> bool:
        """Collect the rollout.

        :param n_steps: Steps of each environment.
        :return: False if a callback has stopped the training.
        :raises FloatingPointError: If a number is not finite.
        """
        model, callback = self.model, self.callback
        model.policy.set_training_mode(False)
        vars(self.buffer).update(pos=0, full=False, generator_ready=False)
        self.obs = obs_as_tensor(model._last_obs, self.device)
        self._check_shapes()
        self.starts = th.as_tensor(model._last_episode_starts, device=self.device).float()
        callback.on_rollout_start()
        with th.no_grad():
            for step in range(n_steps):
                if not self._advance(step, n_steps):
                    self._leave()
                    return False
            last_values = model.policy.predict_values(self.obs).flatten()
        self._leave()
        self._put_together()
        self._check_finite()
        self._fill_buffer(last_values)
        callback.update_locals({"values": last_values, "rollout_buffer": self.buffer})
        callback.on_rollout_end()
        return True

    def _advance(self, index: int, n_steps: int) -> bool:
        """One step of every environment; whether the callbacks let the training go on."""
        model = self.model
        actions, values, record = model.policy(self.obs)
        low, high = self._bounds
        if model.policy.squash_output:
            unbounded = low + (0.5 * (actions + 1.0) * (high - low))
        else:
            unbounded = actions
        clipped = th.clamp(unbounded, low, high)  # of scaled actions, what rounding adds
        step = self.env.env.step(clipped)
        self._last = step
        dones = step.terminated | step.truncated
        new_obs = self.normalizer.observations(step.observations)
        rewards = self.normalizer.rewards(step.rewards, dones)
        model.num_timesteps += self.env.num_envs
        names = self._locals(index, n_steps, actions, values, record)
        names |= {"clipped_actions": clipped, "new_obs": new_obs, "rewards": rewards}
        names |= {"dones": dones, "infos": LazyInfos(step, *self._count(step, dones))}
        self.callback.update_locals(names)
        if not self.callback.on_step():
            return False
        rewards = self._bootstrapped(rewards, step)
        row = {"actions": actions.flatten(1), "rewards": rewards, "values": values.flatten()}
        self._store(index, n_steps, {**row, "episode_starts": self.starts}, record)
        self.obs, self.starts = new_obs, dones.float()
        return True

    def _locals(
        self, index: int, n_steps: int, actions: th.Tensor, values: th.Tensor, record: Any
    ) -> dict[str, Any]:
        """The variables of SB3's loop before the environment's step."""
        return {
            "self": self.model,
            "env": self.model.env,
            "callback": self.callback,
            "rollout_buffer": self.buffer,
            "n_rollout_steps": n_steps,
            "n_steps": index,
            "obs_tensor": self.obs,
            "actions": actions,
            "values": values,
            "log_probs": record,
        }

    def _count(self, step: TensorStep, dones: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Returns and lengths of the episodes that have ended, shape (k,) each."""
        episodes = self.env.episodes
        self._increments[0] = step.rewards
        episodes += self._increments
        returns, lengths = episodes[:, step.ended]
        if len(step.ended) > 0:
            episodes.masked_fill_(dones, 0.0)
            self._ended.append((returns, lengths, step.successes))
        return returns, lengths

    def _bootstrapped(self, rewards: th.Tensor, step: TensorStep) -> th.Tensor:
        """Rewards with the values with which episodes continue beyond their time limits."""
        model = self.model
        if len(step.ended) == 0 or model.timeout_bootstrap == "none":
            return rewards
        limits = step.truncated[step.ended] & ~step.terminated[step.ended]
        which = step.ended[limits]
        if len(which) == 0:
            return rewards
        if model.timeout_bootstrap == "terminal":
            finals = map_observations(lambda values: values[limits], step.final_observations)
            observations = self.normalizer.observations(finals, learn=False)
        else:
            observations = map_observations(lambda values: values[which], self.obs)
        values = model.policy.predict_values(observations).flatten()
        return rewards.index_add(0, which, self.buffer.gamma * values)

    def _store(self, index: int, n_steps: int, row: dict[str, th.Tensor], record: Any) -> None:
        """Keep one step; what the buffer calls its arrays is what they are called here."""
        self.record_type = type(record)
        # No one writes to these any more: they are put together at the end, which costs less.
        for name, part in {**row, **record._asdict()}.items():
            self._rows.setdefault(name, []).append(part)
        # Observations may be large, as images are, and two copies of a rollout too much.
        of_keys = self.obs if isinstance(self.obs, dict) else {"": self.obs}
        for key, part in of_keys.items():
            name = f"observations/{key}"
            if name not in self._stored:
                self._stored[name] = self._memory(name, n_steps, part)
            self._stored[name][index] = part

    def _memory(self, name: str, n_steps: int, part: th.Tensor) -> th.Tensor:
        """A tensor for all steps, (n_steps, n_envs, ...): that of the rollout before if it fits."""
        kept: dict[str, th.Tensor] = vars(self.buffer).setdefault("kept_tensors", {})
        memory, shape = kept.get(name), (n_steps, *part.shape)
        if memory is None or (memory.shape, memory.dtype) != (shape, part.dtype):
            memory = kept[name] = th.empty(shape, dtype=part.dtype, device=self.device)
        return memory

    def _put_together(self) -> None:
        """Make one tensor of the steps' tensors of each name."""
        for name, parts in self._rows.items():
            memory = self._memory(name, len(parts), parts[0])
            self._stored[name] = th.stack(parts, out=memory)
        self._rows.clear()

    def _fill_buffer(self, last_values: th.Tensor) -> None:
        """Let the buffer have the rollout, with advantages and returns."""
        stored, buffer = self._stored, self.buffer
        observations = {
            name.split("/", 1)[1]: stored.pop(name)
            for name in list(stored)
            if name.startswith("observations/")
        }
        is_dict = isinstance(self.obs, dict)
        stored["advantages"] = advantages_of(stored, last_values, self.starts, buffer)
        stored["returns"] = stored["advantages"] + stored["values"]
        contents: Any = {
            **stored,
            "observations": observations if is_dict else observations[""],
            "record_type": self.record_type,
            "pos": buffer.buffer_size,
            "full": True,
        }
        vars(buffer).update(contents)

    def _leave(self) -> None:
        """Bring to the model what the next rollout begins with, and what is logged."""
        model, step = self.model, self._last
        self.normalizer.write_back(step.observations, step.rewards)
        model._last_obs = map_observations(lambda values: values.cpu().numpy().copy(), self.obs)
        model._last_episode_starts = self.starts.cpu().numpy().astype(bool)
        for returns, lengths, successes in self._ended:
            for episode_return, length in zip(returns.tolist(), lengths.tolist(), strict=True):
                model.ep_info_buffer.append({"r": episode_return, "l": int(length)})
            if successes is not None:
                model.ep_success_buffer.extend(successes.tolist())

    def _check_shapes(self) -> None:
        """Refuse observations that are not those of the space."""
        space = self.model.observation_space
        parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
        found = self.obs if isinstance(self.obs, dict) else {"": self.obs}
        for key, part in parts.items():
            if tuple(found[key].shape[1:]) != part.shape:
                raise ValueError(
                    f"The environment's observation {key!r} has shape "
                    f"{tuple(found[key].shape[1:])}, but its space has {part.shape}: change one of "
                    "them."
                )

    def _check_finite(self) -> None:
        """Stop at rewards or observations that are not finite."""
        for name, values in self._stored.items():
            is_checked = name == "rewards" or (
                name.startswith("observations/") and not self.model.allow_nan_observations
            )
            if is_checked and not all_finite(values):
                what = name.replace("observations/", "observation ").replace("rewards", "reward")
                finite = th.isfinite(values).flatten(1).all(dim=1)
                step = int((~finite).nonzero()[0])
                timestep = self.first_timestep + (step + 1) * self.env.num_envs
                rows = values[step].cpu().numpy()
                check_finite(rows, f"The environment's {what.strip()}", timestep, ADVICE)


def advantages_of(
    stored: dict[str, th.Tensor],
    last_values: th.Tensor,
    dones: th.Tensor,
    buffer: RolloutBuffer,
) -> th.Tensor:
    """Generalized advantage estimates, as SB3's buffer computes them.

    :param stored: ``rewards``, ``values`` and ``episode_starts``, shape (n_steps, n_envs).
    :param last_values: Values of the observations after the last step, shape (n_envs,).
    :param dones: 1 where the last step has ended an episode, else 0, shape (n_envs,).
    :param buffer: Has gamma and lambda.
    :return: Shape (n_steps, n_envs).
    """
    rewards, values, starts = (stored[name] for name in ("rewards", "values", "episode_starts"))
    following = th.cat([values[1:], last_values.unsqueeze(0)])
    continues = 1.0 - th.cat([starts[1:], dones.unsqueeze(0)])
    # All steps at once, but for the sum that runs backwards
    deltas = rewards + buffer.gamma * following * continues - values
    factors = buffer.gamma * buffer.gae_lambda * continues
    advantage = th.zeros_like(last_values)
    advantages = []
    for delta, factor in zip(deltas.unbind()[::-1], factors.unbind()[::-1], strict=True):
        advantage = delta + factor * advantage
        advantages.append(advantage)
    return th.stack(advantages[::-1])
