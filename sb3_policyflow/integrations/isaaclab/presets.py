"""Hyperparameters of the paper's eight IsaacLab tasks, in the form of IsaacLab's registry.

Each is a function without arguments that returns a new dictionary of plain values, as in IsaacLab's
own files for Stable-Baselines3: "nn.ELU" for the class, and ``n_minibatches`` instead of
``batch_size``.
"""

from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym

AGENT_KEY = "sb3_policyflow_cfg_entry_point"
"""The key of the hyperparameters in IsaacLab's registry, and the default of ``--agent``."""

PAPER_N_ENVS = 4096


def agent(
    net_arch: list[int],
    learning_rate: float,
    ent_coef: float,
    brownian_coef: float,
    n_steps: int,
    n_iterations: int,
    gamma: float = 0.99,
    embedding_dim: int = 64,
) -> dict[str, Any]:
    """Arguments of PolicyFlow: those of one task, and those that all tasks of the paper share.

    :param net_arch: Hidden layers of actor and critic.
    :param learning_rate: Initial value of the adaptive learning rate.
    :param ent_coef: w_g.
    :param brownian_coef: w_b.
    :param n_steps: Steps of each environment in a rollout.
    :param n_iterations: Number of updates. The paper does not give it: these are those of
        IsaacLab's own configurations for RSL-RL, in 4096 environments.
    :param gamma: Discount factor.
    :param embedding_dim: Size of the time and observation embeddings.
    """
    return {
        "seed": 42,
        "policy": "MlpFlowPolicy",
        "n_timesteps": n_iterations * n_steps * PAPER_N_ENVS,
        "n_steps": n_steps,
        "n_minibatches": 4,
        "n_epochs": 5,
        "learning_rate": learning_rate,
        "desired_kl": 0.01,
        "gamma": gamma,
        "gae_lambda": 0.95,
        "clip_range": 0.2,
        "clip_range_vf": 0.2,
        "ent_coef": ent_coef,
        "brownian_coef": brownian_coef,
        "vf_coef": 1.0,
        "max_grad_norm": 1.0,
        "n_flow_steps": 12,
        "solver": "midpoint",
        # From the last observation that the policy has seen, as RSL-RL does.
        "timeout_bootstrap": "current",
        "policy_kwargs": {
            "net_arch": list(net_arch),
            "activation_fn": "nn.ELU",
            "embedding_dim": embedding_dim,
        },
    }


SMALL, LARGE = [256, 128, 64], [512, 256, 128]

# The paper's tables of variable hyperparameters, in its order.
lift_cube_franka = partial(agent, SMALL, 1e-4, 0.004, 0.002, 24, 1500, gamma=0.98)
navigation_anymal_c = partial(agent, [128, 128], 1e-3, 0.0025, 0.0025, 8, 1500)
quadcopter = partial(agent, [128, 128], 5e-4, 0.005, 0.005, 24, 200)
flat_anymal_d = partial(agent, [128, 128, 128], 1e-3, 0.0025, 0.0025, 24, 300)
rough_h1 = partial(agent, LARGE, 1e-3, 0.005, 0.005, 24, 3000, embedding_dim=512)
rough_go2 = partial(agent, LARGE, 1e-3, 0.008, 0.002, 24, 1500, embedding_dim=512)
open_drawer_franka = partial(agent, SMALL, 5e-4, 0.0008, 0.0002, 96, 400)
rough_g1 = partial(agent, LARGE, 1e-3, 0.002, 0.006, 24, 3000, embedding_dim=256)


class Names(NamedTuple):
    """Ids of one task in IsaacLab 2 and 3; None if version 3 seems not to have it."""

    two: str
    three: str | None


TASKS: dict[str, Names] = {
    "lift_cube_franka": Names("Isaac-Lift-Cube-Franka-v0", "IsaacContrib-Lift-Cube-Franka"),
    "navigation_anymal_c": Names(
        "Isaac-Navigation-Flat-Anymal-C-v0", "IsaacContrib-Navigation-Flat-AnymalC"
    ),
    "quadcopter": Names("Isaac-Quadcopter-Direct-v0", None),
    "flat_anymal_d": Names("Isaac-Velocity-Flat-Anymal-D-v0", "Isaac-Velocity-Flat-AnymalD"),
    "rough_h1": Names("Isaac-Velocity-Rough-H1-v0", "Isaac-Velocity-Rough-H1"),
    "rough_go2": Names("Isaac-Velocity-Rough-Unitree-Go2-v0", "Isaac-Velocity-Rough-UnitreeGo2"),
    "open_drawer_franka": Names("Isaac-Open-Drawer-Franka-v0", "Isaac-Open-Drawer-Franka"),
    "rough_g1": Names("Isaac-Velocity-Rough-G1-v0", "Isaac-Velocity-Rough-G1"),
}
"""Ids of the tasks, by the names of their presets in this module."""


def register_presets() -> list[str]:
    """Add the presets to those of the paper's tasks that IsaacLab has registered with Gymnasium.

    Hyperparameters that a user has registered under the same key are kept.

    :return: Ids of the tasks that have hyperparameters now.
    """
    found = []
    for preset, names in TASKS.items():
        for task in names:
            if task in gym.registry:
                gym.registry[task].kwargs.setdefault(AGENT_KEY, f"{__name__}:{preset}")
                found.append(task)
    return found
