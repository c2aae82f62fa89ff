"""What ``VecNormalize`` does, on tensors."""

from typing import Any

import torch as th
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow.envs.tensor import TensorObs, map_observations


class TensorStatistics:
    """SB3's ``RunningMeanStd`` as float64 tensors.

    :param statistics: The statistics to go on from.
    :param device: Where the tensors are.
    """

    def __init__(self, statistics: RunningMeanStd, device: th.device) -> None:
        self._statistics = statistics
        self.mean = th.as_tensor(statistics.mean, dtype=th.float64, device=device)
        self.var = th.as_tensor(statistics.var, dtype=th.float64, device=device)
        self.count = statistics.count

    def update(self, values: th.Tensor) -> None:
        """Take in one row of each environment, shape (n, ...)."""
        values = values.double()
        mean, n = values.mean(dim=0), len(values)
        delta, total = mean - self.mean, self.count + n
        squares = (values - mean).square().sum(dim=0) + delta**2 * (self.count * n / total)
        self.var = (self.var * self.count + squares) / total
        self.mean = self.mean + delta * (n / total)
        self.count = total

    def write_back(self) -> None:
        """Hand the numbers to SB3's object."""
        self._statistics.mean = self.mean.cpu().numpy()
        self._statistics.var = self.var.cpu().numpy()
        self._statistics.count = self.count


class TensorNormalizer:
    """Normalizes observations and rewards as a ``VecNormalize`` would, and goes on for it.

    The wrapper keeps the options, and gets the numbers back with :meth:`write_back`: its ``save``,
    ``load`` and the evaluation with it are SB3's own.

    :param wrapper: The wrapper; None to change nothing.
    :param device: Where the tensors are.
    """

    def __init__(self, wrapper: VecNormalize | None, device: th.device) -> None:
        self._wrapper = wrapper
        self._of_observations: dict[str | None, TensorStatistics] = {}
        if wrapper is None:
            return
        if wrapper.norm_obs:
            found: Any = wrapper.obs_rms
            by_key = found if isinstance(found, dict) else {None: found}
            self._of_observations = {k: TensorStatistics(v, device) for k, v in by_key.items()}
        self._of_returns = TensorStatistics(wrapper.ret_rms, device)
        self._returns = th.as_tensor(wrapper.returns, dtype=th.float64, device=device)

    def observations(self, observations: TensorObs, learn: bool = True) -> TensorObs:
        """Normalized observations.

        :param observations: Those of some environments.
        :param learn: Whether the statistics take them in, if the wrapper is training.
        """
        wrapper = self._wrapper
        if wrapper is None or not wrapper.norm_obs:
            return observations
        is_dict = isinstance(observations, dict)
        normalized = dict(observations) if is_dict else {None: observations}
        for key, statistics in self._of_observations.items():
            values = normalized[key]
            if learn and wrapper.training:
                statistics.update(values)
            scaled = (values - statistics.mean) / (statistics.var + wrapper.epsilon).sqrt()
            normalized[key] = scaled.clamp(-wrapper.clip_obs, wrapper.clip_obs).float()
        return normalized if is_dict else normalized[None]

    def rewards(self, rewards: th.Tensor, dones: th.Tensor) -> th.Tensor:
        """Normalized rewards of a step, shape (n,).

        :param rewards: The environments'.
        :param dones: Where an episode has ended.
        """
        wrapper = self._wrapper
        if wrapper is None:
            return rewards
        if wrapper.training:
            self._returns = self._returns * wrapper.gamma + rewards
            self._of_returns.update(self._returns)
        if wrapper.norm_reward:
            rewards = rewards / (self._of_returns.var + wrapper.epsilon).sqrt()
            rewards = rewards.clamp(-wrapper.clip_reward, wrapper.clip_reward).float()
        self._returns = self._returns.masked_fill(dones, 0.0)
        return rewards

    def write_back(self, observations: TensorObs, rewards: th.Tensor) -> None:
        """Let the wrapper go on from here.

        :param observations: The last ones that the environments returned.
        :param rewards: The last rewards.
        """
        if self._wrapper is None:
            return
        for statistics in (*self._of_observations.values(), self._of_returns):
            statistics.write_back()
        self._wrapper.returns = self._returns.cpu().numpy()
        self._wrapper.old_obs = map_observations(lambda v: v.cpu().numpy().copy(), observations)
        self._wrapper.old_reward = rewards.cpu().numpy()
