"""Compares the tests' fake of IsaacLab's wrapper with a real one, which needs no simulator.

python tests/scripts/isaaclab_contract.py 2|3 PATH/TO/isaaclab_rl/sb3.py

Both wrap the same environment; all that they return must have the same types and values. Then
PolicyFlow trains with the real one.
"""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

sys.path.insert(
    0, str(Path(__file__).parents[1] / "integrations" / "isaaclab" / "fake_isaaclab" / "common")
)
import fake_lab

from sb3_policyflow import PolicyFlow
from sb3_policyflow.integrations.isaaclab import presets

N_ENVS, N_STEPS = 32, 200


def load_wrapper(path: str) -> ModuleType:
    """Import the real wrapper, with what it imports of IsaacLab replaced."""
    for name in ("isaaclab_rl", "isaaclab_rl.utils", "isaaclab_rl.utils.env_types"):
        sys.modules[name] = ModuleType(name)
    sys.modules["isaaclab_rl.utils.env_types"].check_env_type = lambda env: None  # type: ignore[attr-defined]
    for name in ("isaaclab", "isaaclab.envs"):
        sys.modules[name] = ModuleType(name)
    for name in ("DirectRLEnv", "ManagerBasedRLEnv"):
        setattr(sys.modules["isaaclab.envs"], name, fake_lab.LabEnv)
    spec = importlib.util.spec_from_file_location("isaaclab_rl.sb3", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def environment(computes_last: bool) -> Any:
    config: Any = fake_lab.EnvConfig()
    config.scene.num_envs, config.compute_final_obs = N_ENVS, computes_last
    return fake_lab.LabEnv(config)


def assert_same(one: Any, other: Any) -> None:
    """Compare types and values, through lists and dictionaries."""
    assert type(one) is type(other), (type(one), type(other))
    if isinstance(one, dict):
        assert list(one) == list(other)
        one, other = list(one.values()), list(other.values())
    if isinstance(one, (list, tuple)):
        assert len(one) == len(other)
        for part, other_part in zip(one, other, strict=True):
            assert_same(part, other_part)
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    else:
        assert one == other


def compare(real: Any, fake: Any) -> int:
    """Step both alike. Returns the number of episodes that ended."""
    assert (real.action_space, real.observation_space) == (
        fake.action_space,
        fake.observation_space,
    )
    assert_same(real.seed(3), fake.seed(3))
    assert_same(real.reset(), fake.reset())
    episodes, generator = 0, np.random.default_rng(0)
    for _ in range(N_STEPS):
        actions = generator.standard_normal((N_ENVS, 2), dtype=np.float32)
        one, other = real.step(actions), fake.step(actions)
        assert_same(one, other)
        episodes += int(one[2].sum())
    assert_same(real.env_is_wrapped(object), fake.env_is_wrapped(object))
    assert_same(real.get_attr("render_mode"), fake.get_attr("render_mode"))
    return episodes


def train(module: ModuleType, env: Any, bootstrap: str) -> None:
    agent = module.process_sb3_cfg(presets.flat_anymal_d(), N_ENVS)
    del agent["n_timesteps"]
    agent["timeout_bootstrap"] = bootstrap
    PolicyFlow(agent.pop("policy"), env, **agent).learn(2 * agent["n_steps"] * N_ENVS)


if __name__ == "__main__":
    version, wrapper_path = sys.argv[1:]
    wrapper = load_wrapper(wrapper_path)
    bounds = {"action_bounds": (-100.0, 100.0)} if version == "3" else {}
    for computes in (False, True) if version == "3" else (False,):
        theirs = wrapper.Sb3VecEnvWrapper(environment(computes), **bounds)
        ended = compare(theirs, fake_lab.Sb3Wrapper(environment(computes), -100.0, 100.0))
        train(wrapper, theirs, "terminal" if computes else "current")
        sys.stdout.write(f"The same over {N_STEPS} steps and {ended} episodes, and trained.\n")
