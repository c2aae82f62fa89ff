"""Benchmarks run, continue, and are summed up, by the commands that users type."""

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from tqdm import tqdm

pytest.importorskip("rl_zoo3")

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.benchmark.__main__ import main
from sb3_policyflow.benchmark.errors import BenchmarkError
from sb3_policyflow.benchmark.figures.plot import curves_figure
from sb3_policyflow.benchmark.measure import costs
from sb3_policyflow.benchmark.measure.evaluation import EvaluationCallback, evaluate, modes
from sb3_policyflow.benchmark.report.table import comparison_table, overall_table, results_table
from sb3_policyflow.benchmark.results import Result, Run, load_results
from sb3_policyflow.benchmark.run import steps_of_runs
from sb3_policyflow.benchmark.train_one import train_and_measure


def benchmark(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "sb3_policyflow.benchmark", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    settings = ["--envs", "Pendulum-v1", "--steps", "10", "--evaluations", "1", "--episodes", "2"]
    return benchmark("run", *settings, "--out", str(folder), "--algos", *arguments)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of two algorithms."""
    path = tmp_path_factory.mktemp("results")
    outcome = run(path, "fpo", "ppo", "--jobs", "2")
    assert outcome.returncode == 0, outcome.stderr
    assert "2/2" in outcome.stderr
    assert outcome.stdout == f"2 of 2 results are in {path}.\n"
    return path


@pytest.mark.slow
def test_what_is_written(folder: Path) -> None:
    files = sorted(str(path.relative_to(folder)) for path in folder.glob("*/*/*"))
    names = [f"Pendulum-v1/seed-0.{suffix}" for suffix in ("csv", "json")]
    assert files == [f"{algo}/{name}" for algo in ("fpo", "ppo") for name in names]
    fpo, ppo = load_results(folder)
    assert [list(r.summary["final"]) for r in (fpo, ppo)] == [
        ["stochastic", "latent-only", "deterministic"],
        ["stochastic", "deterministic"],
    ]
    # One rollout of 8 times 512 steps, ten epochs in minibatches of 128, eight samples each.
    assert fpo.summary["timesteps"] == 4096
    assert fpo.summary["gradient_steps"] == 320
    assert fpo.summary["network_evaluations"] == {"acting": 40960, "updating": 320 * 128 * 8}
    assert fpo.summary["hyperparams"]["clip_range"] == "0.05"
    assert fpo.summary["versions"]["torch"]
    assert fpo.summary["seconds"]["training"] > 0
    assert fpo.returns("stochastic")[1] == [fpo.final_return("stochastic")]
    assert -2000 < ppo.final_return("deterministic") < 0  # type: ignore[operator]


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["policyflow", "ppo"])
def test_rl_zoo3_enjoys_agents_that_are_kept(tmp_path: Path, algo: str) -> None:
    agents = tmp_path / "agents"
    settings = ["--envs", "MountainCarContinuous-v0", "--steps", "10", "--seeds", "7"]
    settings += ["--evaluations", "1", "--episodes", "1", "--hyperparams", "n_epochs:1"]
    kept = ["--out", str(tmp_path / "results"), "--agents", str(agents)]
    outcome = benchmark("run", "--algos", algo, *settings, *kept)
    assert outcome.returncode == 0, outcome.stderr
    place = agents / "seed-7" / algo / "MountainCarContinuous-v0_1"
    files = {path.relative_to(place).as_posix() for path in place.rglob("*") if path.is_file()}
    name = "MountainCarContinuous-v0"
    described = {f"{name}/{file}" for file in ("args.yml", "config.yml", "vecnormalize.pkl")}
    assert files == {f"{name}.zip", *described}
    model: Any = {"policyflow": PolicyFlow, "ppo": PPO}[algo].load(place / f"{name}.zip")
    n_bytes = 4 * sum(parameter.numel() for parameter in model.policy.parameters())
    assert (place / f"{name}.zip").stat().st_size < n_bytes + 50_000
    command = [sys.executable, "-m", "rl_zoo3.enjoy", "--algo", algo, "--env", name]
    command += ["-f", str(agents / "seed-7"), "--no-render", "-n", "1000"]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert shown.returncode == 0, shown.stderr
    assert "Episode Reward" in shown.stdout


@pytest.mark.slow
def test_what_has_been_run_is_not_run_again(folder: Path) -> None:
    before = (folder / "ppo/Pendulum-v1/seed-0.json").stat().st_mtime_ns
    # What a killed run leaves behind does not count.
    (folder / "ppo/Pendulum-v1/seed-1.json.partial").write_text("{")
    outcome = run(folder, "ppo", "--seeds", "0", "1")
    assert outcome.returncode == 0, outcome.stderr
    assert (folder / "ppo/Pendulum-v1/seed-0.json").stat().st_mtime_ns == before
    assert len(load_results(folder)) == 3


@pytest.mark.slow
def test_hyperparams_of_the_command(tmp_path: Path) -> None:
    settings = ["--hyperparams", "n_envs:2", "n_steps:8", "policy_kwargs:'dict(net_arch=[4])'"]
    outcome = run(tmp_path, "policyflow", "ppo", *settings)
    assert outcome.returncode == 0, outcome.stderr
    for result in load_results(tmp_path):
        assert result.run.hyperparams["n_steps"] == 8
        assert result.summary["timesteps"] == 16
        assert result.summary["hyperparams"]["policy_kwargs"] == "dict(net_arch=[4])"


def test_a_falling_learning_rate_ends_at_zero_not_below() -> None:
    remaining = []

    def schedule(progress_remaining: float) -> float:
        remaining.append(progress_remaining)
        return 1e-3 * progress_remaining

    env = make_vec_env("Pendulum-v1", 2)
    model = PPO("MlpPolicy", env, schedule, n_steps=8, batch_size=16, device="cpu")
    summary = train_and_measure(model, 40, EvaluationCallback(env, [40], n_episodes=1), [])
    assert summary["timesteps"] == 48
    assert min(remaining) == 0


@pytest.mark.slow
def test_other_settings_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = ["--algos", "fpo", "--envs", "Pendulum-v1", "--steps", "11", "--out", str(folder)]
    assert main(["run", *settings]) == 2
    assert "was made with other settings" in capsys.readouterr().err


@pytest.mark.slow
def test_a_failing_run_is_reported_and_its_log_kept(tmp_path: Path) -> None:
    outcome = run(tmp_path, "fpo", "--hyperparams", "n_steps:-1")
    assert outcome.returncode == 1
    assert "failed: fpo Pendulum-v1 seed 0" in outcome.stderr
    log = (tmp_path / "fpo/Pendulum-v1/seed-0.log").read_text()
    assert "n_steps" in log
    assert log.endswith("exit code 1\n")


@pytest.mark.slow
def test_a_figure_says_what_failed_though_there_is_nothing_to_draw(tmp_path: Path) -> None:
    settings = ["--steps", "10", "--variants", "a-ppo", "--out", str(tmp_path)]
    # Where the curve would go there is a folder: the training fails.
    (tmp_path / "a-ppo" / "MultiGoal-v0" / "seed-0.csv").mkdir(parents=True)
    outcome = benchmark("multigoal", *settings, "--evaluations", "1", "--episodes", "1")
    assert outcome.returncode == 2
    assert "failed: a-ppo MultiGoal-v0 seed 0\nNo results in" in outcome.stderr


NUMBERS = {
    "run": ("--steps", "--evaluations", "--episodes", "--jobs", "--threads", "--seeds"),
    "multigoal": ("--steps", "--evaluations", "--seeds"),
    "imitation": ("--steps", "--evaluations", "--seeds"),
    "agent": ("--steps", "--episodes", "--seeds"),
    "demo": ("--steps", "--seed"),
    "card": ("--episodes",),
    "speed": ("--repetitions", "--threads"),
    "environments": ("--num-envs", "--seconds"),
}
REQUIRED = {"run": ["--envs", "Pendulum-v1", "--steps", "10"], "card": ["model", "--env", "a-v0"]}


@pytest.mark.parametrize(
    ("subcommand", "option"), [(name, option) for name in NUMBERS for option in NUMBERS[name]]
)
def test_numbers_that_make_no_sense_are_refused_before_a_training(
    subcommand: str, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    number = "-1" if option in ("--seed", "--seeds") else "0"
    with pytest.raises(SystemExit) as exit_of:
        main([subcommand, *REQUIRED.get(subcommand, []), option, number])
    assert exit_of.value.code == 2
    said = capsys.readouterr().err
    assert f"argument {option}: must be at least" in said
    assert said.endswith(f", got {number}\n")


@pytest.mark.parametrize("steps", ["inf", "nan", "1e400", "many"])
def test_steps_without_an_end_are_refused(steps: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["run", "--envs", "Pendulum-v1", "--steps", steps])
    assert "argument --steps: " in capsys.readouterr().err


@pytest.mark.parametrize("subcommand", ["run", "playground"])
def test_environments_that_there_are_not_are_named_before_a_training(
    subcommand: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    which = {"run": ["--envs", "Pendulun-v1"], "playground": ["--tasks", "CheetaRun"]}
    settings = ["--steps", "10", "--out", str(tmp_path)]
    assert main([subcommand, *which[subcommand], *settings]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "Pendulum" in said or "CheetahRun" in said or "playground" in said
    assert not list(tmp_path.iterdir())


def test_a_misspelt_hyperparameter_is_refused_before_a_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = ["--envs", "Pendulum-v1", "--steps", "10", "--out", str(tmp_path)]
    for algo, name in (("policyflow", "n_epoch"), ("ppo", "n_epoch")):
        with pytest.raises(SystemExit, match=r"no hyperparameter 'n_epoch': did you mean n_epochs"):
            main(["run", *settings, "--algos", algo, "--hyperparams", f"{name}:4"])
    assert not list(tmp_path.iterdir())


def test_a_hyperparameter_without_json_is_refused_before_a_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = ["--envs", "Pendulum-v1", "--steps", "10", "--out", str(tmp_path), "--algos", "ppo"]
    assert main(["run", *settings, "--hyperparams", "policy_kwargs:dict(a=dict)"]) == 2
    said = capsys.readouterr().err
    assert "policy_kwargs:{'a': <class 'dict'>} cannot be written to a JSON file" in said
    assert "\"policy_kwargs:'dict(...)'\"" in said
    assert not list(tmp_path.iterdir())


def test_hyperparameters_are_the_same_after_saving(tmp_path: Path) -> None:
    """JSON has lists alone, and a file may be older than the newest field of a run."""
    made = Run("a", "ppo", "Env-v0", 3, 10, {"log_std_bounds": (-2.0, 0.0), "kwargs": {"a": (1,)}})
    Result(made, {"final": {}}, []).save(tmp_path)
    assert made.is_done(tmp_path)
    path = made.path(tmp_path, ".json")
    kept = json.loads(path.read_text())
    del kept["run"]["keep_visits"]
    path.write_text(json.dumps(kept))
    assert made.is_done(tmp_path)
    assert load_results(tmp_path)[0].run.keep_visits is False
    with pytest.raises(BenchmarkError, match="was made with other settings"):
        replace(made, hyperparams={"log_std_bounds": (-1.0, 0.0)}).is_done(tmp_path)
    kept["run"]["newer"] = 1
    path.write_text(json.dumps(kept))
    with pytest.raises(BenchmarkError, match=r"of another version of this package .*'newer'"):
        made.is_done(tmp_path)


def test_how_far_a_training_is_by_its_log(tmp_path: Path) -> None:
    run = Run("ppo", "ppo", "Pendulum-v1", 0, 10)
    log = run.path(tmp_path, ".log")
    log.parent.mkdir(parents=True)
    bar = tqdm(total=1, disable=True)
    shown = []
    bar.set_postfix_str = shown.append  # type: ignore[method-assign,assignment]
    for text in ("", "warning", "trained: 10%\ntrained: 50%\n", "trained: 90%\nexit code 0\n"):
        log.write_text(text)
        with steps_of_runs([run], tmp_path, bar, every=0.01):
            time.sleep(0.1)
    assert list(dict.fromkeys(shown)) == ["", f"{run}: starting", f"{run}: 50%"]


def test_an_unknown_algorithm_is_refused_with_the_choices(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["run", "--algos", "pfo", "--envs", "Pendulum-v1", "--steps", "10"])
    assert "choose from" in (said := capsys.readouterr().err)
    assert "policyflow" in said


@pytest.mark.parametrize(
    ("command", "module"),
    [("pointmaze", "gymnasium_robotics"), ("playground", "mujoco_playground")],
)
def test_a_missing_extra_is_named_before_a_training(
    command: str,
    module: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    assert main([command, "--out", str(tmp_path)]) == 2
    assert f"needs {module}: run `pip install" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_results_of_some_environments(tmp_path: Path) -> None:
    for env in ("Pendulum-v1", "Acrobot-v1"):
        result("ours", 0, 1.0, env).save(tmp_path)
    assert [r.run.env for r in load_results(tmp_path, ["Acrobot-v1"])] == ["Acrobot-v1"]
    with pytest.raises(BenchmarkError, match="No results of CartPole-v1"):
        load_results(tmp_path, ["CartPole-v1"])


def test_there_is_no_curve_of_seeds_that_were_evaluated_at_different_timesteps() -> None:
    def curve(seed: int, *timesteps: float) -> Result:
        rows = [{"timesteps": t, "mode": "stochastic", "mean_return": t} for t in timesteps]
        settings = Run("ours", "ppo", "Pendulum-v1", seed, 100)
        return Result(settings, {"final": {}}, rows)

    lines = curves_figure([curve(0, 50, 100), curve(1, 50, 100)]).axes[0].lines
    assert lines[0].get_xydata().tolist() == [[50, 50], [100, 100]]  # type: ignore[union-attr]
    with pytest.raises(BenchmarkError, match="ours in Pendulum-v1 were not evaluated at the same"):
        curves_figure([curve(0, 50, 100), curve(1, 500, 1000)])


@pytest.mark.slow
def test_table_and_plot(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["table", str(folder), "--out", str(tmp_path / "table.md")]) == 0
    assert capsys.readouterr().out == f"Wrote {tmp_path / 'table.md'}.\n"
    assert "| Pendulum-v1, 4,096 steps | fpo | 1 |" in (tmp_path / "table.md").read_text()
    assert main(["plot", str(folder), "--out", str(tmp_path)]) == 0
    written = [tmp_path / name for name in ("curves.png", "improvement.png")]
    assert capsys.readouterr().out == f"Wrote {written[0]} and {written[1]}.\n"
    assert (tmp_path / "curves.png").stat().st_size > 10_000
    assert (tmp_path / "improvement.png").stat().st_size > 5_000


def test_no_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["table", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("No results in")


@pytest.mark.parametrize(("arguments", "code"), [(["--help"], 0), (["nonsense"], 2), ([], 0)])
def test_usage(arguments: list[str], code: int, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_of:
        main(arguments)
    assert exit_of.value.code == code
    written = capsys.readouterr()
    assert "multigoal" in written.out + written.err


def result(name: str, seed: int, value: float, env: str = "Pendulum-v1") -> Result:
    summary: dict[str, Any] = {
        "final": {"stochastic": {"mean_return": value}},
        "timesteps": 8192,  # whole rollouts, where 100 were asked for
        "gradient_steps": 1000,
        "network_evaluations": {"acting": 1e6, "updating": 2e6},
        "seconds": {"training": 90.0},
    }
    return Result(Run(name, name, env, seed, 100), summary, [])


def test_tables_by_hand() -> None:
    results = [result("ours", seed, value) for seed, value in enumerate([1.0, 3.0, 5.0, 99.0])]
    results += [result("theirs", seed, float(seed)) for seed in range(5)]
    ours, theirs = results_table(results).splitlines()[2:]
    assert ours.startswith("| Pendulum-v1, 8,192 steps | ours | 4 | 27 (1 to 99) |")
    assert ours.endswith("| - | - | 1,000 | 1.0 M / 2.0 M | 1.5 |")
    assert "| theirs | 5 | 2 [" in theirs
    assert "| ours | theirs | 0.75 (15 of 20) |" in comparison_table(results)
    results.append(result("ours", 4, 2.0))
    assert "| ours | theirs | 0.70 [" in comparison_table(results)


def test_a_benchmark_that_is_not_complete_is_compared_by_what_it_has() -> None:
    """Of the seeds, those that a name has in every environment that both names have."""
    results = [result("ours", seed, value) for seed, value in enumerate([1.0, 3.0])]
    results += [result("theirs", seed, 2.0) for seed in range(2)]
    results += [result("ours", 0, 1.0, "Acrobot-v1"), result("theirs", 0, 2.0, "Acrobot-v1")]
    # Of "ours" over both environments: seed 0, with 1 in each.
    assert "| ours | 2 x 1 | 1 | - | - |" in overall_table(results)
    # Seed 0 only, of both environments: ours is worse in each. Seed 1, better, does not count.
    assert "| ours | theirs | 0.00 (0 of 2) |" in comparison_table(results)
    # An environment that only one of them has leaves the others as they are.
    results += [result("ours", 7, 9.0, "CartPole-v1"), result("alone", 0, 9.0, "CartPole-v1")]
    assert "| ours | theirs | 0.00 (0 of 2) |" in comparison_table(results)
    assert "| alone | theirs |" not in comparison_table(results)
    assert "| theirs | 0 x 0 | - | - | - |" in overall_table(results)


def test_overall_table_by_hand() -> None:
    """The interquartile mean of 0, 1, ..., 7 is that of 2, 3, 4, 5."""
    results = [result("a", seed, float(seed), "CartPole-v1") for seed in range(4)]
    results += [result("a", seed, 4.0 + seed, "Acrobot-v1") for seed in range(4)]
    assert "| a | 2 x 4 | 3.5 [" in overall_table(results)


def test_results_survive_saving(tmp_path: Path) -> None:
    row = {"timesteps": 10.0, "mode": "stochastic", "mean_return": -1.5, "std_return": 0.5}
    saved = Result(Run("a", "ppo", "Env-v0", 3, 10, {"n_envs": 2}), {"final": {}}, [row])
    row |= {"mean_length": 7.0, "n_episodes": 4.0}
    saved.save(tmp_path)
    assert load_results(tmp_path) == [saved]
    assert saved.run.is_done(tmp_path)
    path = tmp_path / "a/Env-v0/seed-3.json"
    assert json.loads(path.read_text())["run"]["algo"] == "ppo"
    # As version 0.1.0 wrote it.
    path.write_text(path.read_text().replace('"run": {', '"cell": {'))
    assert load_results(tmp_path) == [saved]
    assert saved.run.is_done(tmp_path)


def test_evaluation_leaves_the_training_alone() -> None:
    """Neither the random draws nor the running statistics of the training move."""
    env = VecNormalize(make_vec_env("Pendulum-v1", 2))
    evaluation = VecNormalize(make_vec_env("Pendulum-v1", 2), training=False, norm_reward=False)
    model = FPO("MlpPolicy", env, n_steps=32, batch_size=32, seed=0).learn(64)
    mean = env.obs_rms.mean.copy()  # type: ignore[union-attr]
    state = np.random.get_state()[1].copy()  # type: ignore[index,union-attr]
    found = [evaluate(model, evaluation, mode, 2)["mean_return"] for mode in modes(model)]
    again = [evaluate(model, evaluation, mode, 2)["mean_return"] for mode in modes(model)]
    assert found == again
    assert found[0] == found[1] != found[2]  # no noise but the latents'
    assert model.policy.deterministic_action == "mode"
    np.testing.assert_array_equal(env.obs_rms.mean, mean)  # type: ignore[union-attr]
    np.testing.assert_array_equal(evaluation.obs_rms.mean, mean)  # type: ignore[union-attr]
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # type: ignore[index]


def test_costs() -> None:
    small: dict[str, Any] = {"n_steps": 16, "batch_size": 8, "n_epochs": 1}
    for algorithm, per_action, per_sample in [
        (PolicyFlow("MlpPolicy", "Pendulum-v1", n_times=3, **small), 8, 6),
        (DPPO("MlpPolicy", "Pendulum-v1", n_finetuned_steps=4, **small), 10, 4),
        (PPO("MlpPolicy", "Pendulum-v1", **small), 1, 1),
    ]:
        steps = costs.GradientSteps(algorithm)
        algorithm.learn(32)
        assert steps.count == 4
        found = costs.network_evaluations(algorithm, steps.count)
        assert found == {"acting": 32 * per_action, "updating": 4 * 8 * per_sample}
    whole = A2C("MlpPolicy", "Pendulum-v1", n_steps=16)
    assert costs.network_evaluations(whole, 2)["updating"] == 2 * 16
