"""Exported files act as the policy does, and need nothing of this package."""

import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import nn

import sb3_policyflow
from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.export import ActionModule, export
from sb3_policyflow.export.__main__ import main
from tests.helpers import TINY, TWO_EPOCHS

ort = pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")

NETS = {**TINY, "initialization": "glorot"}
STEPS: dict[type[Any], dict[str, Any]] = {
    PolicyFlow: {"n_flow_steps": 2, "solver": "midpoint"},
    FPO: {"n_flow_steps": 2, "solver": "heun"},
    DPPO: {"n_denoising_steps": 4, "n_finetuned_steps": 2},
}


class Robot(gym.Env[Any, Any]):
    """A camera, joints far from the origin, a counter, a mode and switches; actions 2 by 2."""

    observation_space = spaces.Dict(
        {
            "camera": spaces.Box(0, 255, (36, 36, 3), np.uint8),
            "joints": spaces.Box(-1e3, 1e3, (3,)),
            "mode": spaces.Discrete(3),
            "switches": spaces.MultiBinary(2),
            "doors": spaces.MultiDiscrete([2, 3]),
        }
    )
    action_space = spaces.Box(
        np.array([[-1, 0], [0, -3]], np.float32), np.array([[1, 0.5], [2, 3]], np.float32)
    )

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        return self.observation_space.sample(), float(action.sum()), False, False, {}


def images() -> gym.Env[Any, Any]:
    return FakeImageEnv(screen_height=40, screen_width=40, n_channels=1, discrete=False)


def trained(algorithm: type[Any], policy: str, env: VecEnv | str, **options: Any) -> Any:
    options = {**TWO_EPOCHS, **STEPS[algorithm], **options}
    return algorithm(policy, env, policy_kwargs=NETS, **options).learn(64)


def raw_and_normalized(env: VecNormalize) -> tuple[Any, Any]:
    """Observations as the environment gives them, and as the policy sees them."""
    env.training = False
    normalized = env.reset()
    return env.get_original_obs(), normalized


def run_onnx(path: Path, observations: Any, **more: np.ndarray) -> np.ndarray:
    session = ort.InferenceSession(path)
    inputs = observations if isinstance(observations, dict) else {"observation": observations}
    (actions,) = session.run(["actions"], {**inputs, **more})
    return np.asarray(actions)


def test_mlp_policy(algorithm: type[Any], tmp_path: Path) -> None:
    env = VecNormalize(make_vec_env("Pendulum-v1", 3))
    model = trained(algorithm, "MlpPolicy", env)
    export(model.policy, tmp_path / "policy.onnx", normalize=env)
    raw, normalized = raw_and_normalized(env)
    expected, _ = model.predict(normalized, deterministic=True)
    np.testing.assert_allclose(run_onnx(tmp_path / "policy.onnx", raw), expected, atol=1e-5)
    one = run_onnx(tmp_path / "policy.onnx", raw[:1])
    np.testing.assert_allclose(one, expected[:1], atol=1e-5)
    assert expected.std() > 0


@pytest.mark.slow
def test_cnn_policy(algorithm: type[Any], tmp_path: Path) -> None:
    model = trained(algorithm, "CnnPolicy", make_vec_env(images, 2))
    export(model.policy, tmp_path / "policy.onnx")
    pictures = np.stack([model.observation_space.sample() for _ in range(3)])
    expected, _ = model.predict(pictures, deterministic=True)
    np.testing.assert_allclose(run_onnx(tmp_path / "policy.onnx", pictures), expected, atol=1e-5)


@pytest.mark.slow
def test_dict_policy(algorithm: type[Any], tmp_path: Path) -> None:
    env = VecNormalize(make_vec_env(Robot, 3), norm_obs_keys=["joints"])
    model = trained(algorithm, "MultiInputPolicy", env)
    export(model.policy, tmp_path / "policy.onnx", normalize=env)
    raw, normalized = raw_and_normalized(env)
    expected, _ = model.predict(normalized, deterministic=True)
    raw["camera"] = raw["camera"].transpose(0, 3, 1, 2)
    raw = {key: values.astype(model.observation_space[key].dtype) for key, values in raw.items()}
    actions = run_onnx(tmp_path / "policy.onnx", raw)
    assert actions.shape == (3, 2, 2)
    np.testing.assert_allclose(actions, expected, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "options"),
    [
        (PolicyFlow, {"interpolant": "trigflow", "solver": "rk4"}),
        (PolicyFlow, {"interpolant": "rectified", "solver": "ab2"}),
        (FPO, {"solver": "heun"}),
        (DPPO, {"process": "flow"}),
    ],
    ids=str,
)
def test_latents_are_transported_as_by_the_policy(
    algorithm: type[Any], options: dict[str, Any], tmp_path: Path
) -> None:
    model = trained(algorithm, "MlpPolicy", "Pendulum-v1", **options)
    export(model.policy, tmp_path / "policy.onnx", latents=True)
    obs = np.stack([model.observation_space.sample() for _ in range(5)])
    latents = np.random.randn(5, 1).astype(np.float32)
    with th.no_grad():
        features = model.policy.actor_features(th.as_tensor(obs))
        endpoints = model.policy.transport(th.as_tensor(latents), features).clamp(-2, 2)
    actions = run_onnx(tmp_path / "policy.onnx", obs, latents=latents)
    np.testing.assert_allclose(actions, endpoints, atol=1e-5)
    assert np.ptp(actions) > 0.1


def test_a_chain_without_noise_is_the_record_of_its_means(tmp_path: Path) -> None:
    """DPPO's file with latents takes, from where a drawn chain starts, each step to its mean."""
    model = trained(DPPO, "MlpPolicy", "Pendulum-v1", noise_clip=1e-9, n_finetuned_steps=None)
    export(model.policy, tmp_path / "policy.onnx", latents=True)
    obs = np.stack([model.observation_space.sample() for _ in range(5)])
    with th.no_grad():
        actions, _, record = model.policy(th.as_tensor(obs))
    latents = record.points[:, 0].numpy()
    expected = model.policy.unscale_action(actions.numpy())
    found = run_onnx(tmp_path / "policy.onnx", obs, latents=latents)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    # Drawing the start in predict is for evaluation, and not what is exported.
    model.policy.deterministic_action = "drawn"
    module = ActionModule(model.policy)
    assert th.equal(module(th.as_tensor(obs)), module(th.as_tensor(obs)))


WITHOUT_THIS_PACKAGE = """
import sys
sys.modules.update(sb3_policyflow=None, stable_baselines3=None)
import numpy as np
if sys.argv[1] == "onnx":
    import onnxruntime
    session = onnxruntime.InferenceSession("policy.onnx")
    (actions,) = session.run(None, {"observation": np.load("obs.npy")})
else:
    import torch
    program = torch.export.load("policy.pt2").module()
    actions = program(torch.as_tensor(np.load("obs.npy"))).detach().numpy()
np.save("actions.npy", actions)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "kind"), [(PolicyFlow, "onnx"), (DPPO, "pt2")])
def test_command_line_writes_files_that_load_without_this_package(
    algorithm: type[Any], kind: str, tmp_path: Path
) -> None:
    env = VecNormalize(make_vec_env("Pendulum-v1", 3))
    model = trained(algorithm, "MlpPolicy", env)
    model.save(tmp_path / "model.zip")
    env.save(str(tmp_path / "stats.pkl"))
    raw, normalized = raw_and_normalized(env)
    np.save(tmp_path / "obs.npy", raw)
    output = tmp_path / f"policy.{kind}"
    stats = str(tmp_path / "stats.pkl")
    main([str(tmp_path / "model.zip"), str(output), "--vecnormalize", stats])
    subprocess.run(
        [sys.executable, "-c", WITHOUT_THIS_PACKAGE, kind], cwd=tmp_path, check=True, timeout=300
    )
    expected, _ = model.predict(normalized, deterministic=True)
    np.testing.assert_allclose(np.load(tmp_path / "actions.npy"), expected, atol=1e-5)


@pytest.mark.parametrize(("algorithm", "bound"), [(FPO, 2.0), (DPPO, -2.0)])
def test_the_module_itself_and_the_bounds_of_actions(algorithm: type[Any], bound: float) -> None:
    """DPPO's network predicts the noise, which points away from the action."""
    model = trained(algorithm, "MlpPolicy", "Pendulum-v1")
    with th.no_grad():
        model.policy.velocity.output.bias.fill_(100.0)
    obs = th.as_tensor(np.stack([model.observation_space.sample() for _ in range(4)]))
    assert (ActionModule(model.policy)(obs) == bound).all()


@pytest.mark.parametrize("kind", ["onnx", "pt2"])
def test_no_folder_of_this_machine_is_in_the_file(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"policy.{kind}"
    export(PolicyFlow("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY).policy, path)
    written = path.read_bytes()
    if kind == "pt2":
        with zipfile.ZipFile(path) as archive:
            written = b"".join(archive.read(name) for name in archive.namelist())
    assert b"velocity" in written  # names of parameters can be read
    for module in (sb3_policyflow, th):
        assert str(Path(module.__file__ or "").parent).encode() not in written


def test_what_cannot_be_exported(tmp_path: Path) -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1")
    with pytest.raises(ValueError, match=r"must end in '\.onnx' or '\.pt2', got 'policy\.pb'"):
        export(model.policy, "policy.pb")
    PPO("MlpPolicy", "Pendulum-v1").save(tmp_path / "ppo.zip")
    with pytest.raises(SystemExit, match="which is no flow policy"):
        main([str(tmp_path / "ppo.zip"), str(tmp_path / "policy.onnx")])
    with pytest.raises(SystemExit, match=r"There is no file .*nope\.zip\."):
        main([str(tmp_path / "nope"), str(tmp_path / "policy.onnx")])


def test_the_model_may_be_named_without_its_ending(tmp_path: Path) -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY)
    model.save(tmp_path / "model_0.5.zip")
    model.save(tmp_path / "model_0.7")  # SB3 adds no ending where there is a dot
    for name in ("model_0.5", "model_0.5.zip", "model_0.7"):
        main([str(tmp_path / name), str(tmp_path / f"{name}.pt2")])
        assert (tmp_path / f"{name}.pt2").is_file()
    with pytest.raises(SystemExit, match=r"There is no file .*model_0\.9\.zip\."):
        main([str(tmp_path / "model_0.9"), str(tmp_path / "policy.pt2")])


class Double(gym.Env[Any, Any]):
    """Observations of float64, as MuJoCo's, far from zero."""

    observation_space = spaces.Box(-1e6, 1e6, (3,), np.float64)
    action_space = spaces.Box(-1, 1, (2,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.np_random.normal(100.0, 50.0, 3), {}

    def step(self, action: Any) -> Any:
        return self.np_random.normal(100.0, 50.0, 3), 0.0, False, False, {}


def test_the_normalization_cannot_be_forgotten(tmp_path: Path) -> None:
    env = VecNormalize(make_vec_env(Double, 2))
    model = trained(PolicyFlow, "MlpPolicy", env)
    model.save(tmp_path / "model")
    env.save(str(tmp_path / "model_vecnormalize.pkl"))
    command = [str(tmp_path / "model"), str(tmp_path / "policy.pt2")]
    with pytest.raises(SystemExit, match=r"give them as .*There is .*model_vecnormalize\.pkl"):
        main(command)
    main([*command, "--normalized-input"])
    with pytest.raises(ValueError, match="trained with VecNormalize"):
        export(PolicyFlow.load(tmp_path / "model"), tmp_path / "policy.pt2")
    # Saving what was loaded without an environment does not lose it.
    PolicyFlow.load(tmp_path / "model").save(tmp_path / "again")
    with pytest.raises(SystemExit, match="trained with VecNormalize"):
        main([str(tmp_path / "again"), str(tmp_path / "policy.pt2")])


def test_normalization_that_the_model_does_not_know_is_refused(tmp_path: Path) -> None:
    env = VecNormalize(make_vec_env(Double, 2))
    env.save(str(tmp_path / "stats.pkl"))
    model = trained(PolicyFlow, "MlpPolicy", make_vec_env(Double, 2))
    model.save(tmp_path / "model")
    path = tmp_path / "policy.pt2"
    with pytest.raises(ValueError, match=r"leave out normalize \(--vecnormalize\)"):
        export(model, path, normalize=env)
    command = [str(tmp_path / "model"), str(path)]
    with pytest.raises(SystemExit, match=r"leave out normalize \(--vecnormalize\)"):
        main([*command, "--vecnormalize", str(tmp_path / "stats.pkl")])
    assert not path.exists()
    (tmp_path / "text.pkl").write_text("text")
    with pytest.raises(SystemExit, match=r"text\.pkl cannot be read as statistics"):
        main([*command, "--vecnormalize", str(tmp_path / "text.pkl")])


def test_rewards_alone_are_no_matter_of_the_policy(tmp_path: Path) -> None:
    model = trained(PolicyFlow, "MlpPolicy", VecNormalize(make_vec_env(Double, 2), norm_obs=False))
    model.save(tmp_path / "model")
    main([str(tmp_path / "model"), str(tmp_path / "policy.pt2")])


@pytest.mark.parametrize("normalized", [True, False])
def test_the_file_takes_observations_as_the_environment_gives_them(
    normalized: bool, tmp_path: Path
) -> None:
    env: Any = make_vec_env(Double, 2)
    env = VecNormalize(env) if normalized else env
    model = trained(PolicyFlow, "MlpPolicy", env)
    export(model, tmp_path / "policy.onnx")
    model.save(tmp_path / "model")
    command = [str(tmp_path / "model"), str(tmp_path / "again.onnx")]
    if normalized:
        env.save(str(tmp_path / "stats.pkl"))
        command += ["--vecnormalize", str(tmp_path / "stats.pkl")]
    main(command)
    observation = Double().reset(seed=0)[0][None]
    seen = env.normalize_obs(observation) if normalized else observation
    expected, _ = model.predict(seen, deterministic=True)
    for name in ("policy.onnx", "again.onnx"):
        np.testing.assert_allclose(run_onnx(tmp_path / name, observation), expected, atol=1e-5)


QUIET = """
import sys
from sb3_policyflow.export.__main__ import main
main(["model.zip", "policy.onnx"])
import onnxruntime
session = onnxruntime.InferenceSession("policy.onnx")
print([axis for part in session.get_inputs() + session.get_outputs() for axis in part.shape])
"""


@pytest.mark.slow
def test_nothing_is_said_beside_the_file_and_its_batch_axis_has_a_name(tmp_path: Path) -> None:
    options = {"activation_fn": nn.Mish}
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", policy_kwargs={**NETS, **options}, **TWO_EPOCHS)
    model.save(tmp_path / "model")
    output = subprocess.run(
        [sys.executable, "-c", QUIET],
        cwd=tmp_path,
        check=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ).stdout
    assert output.splitlines() == ["Wrote policy.onnx", "['batch', 3, 'batch', 1]"]


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    PolicyFlow("MlpPolicy", "Pendulum-v1").save(tmp_path / "model")
    with pytest.raises(SystemExit, match=r"needs onnxscript: run `pip install \".*\[onnx\]\"`"):
        main([str(tmp_path / "model"), str(tmp_path / "policy.onnx")])


def test_help_is_plain_text(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    assert "::" not in capsys.readouterr().out
