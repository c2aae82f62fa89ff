"""Write a folder for Hugging Face: a model, and a model card with its measured returns.

Nothing is uploaded: ``huggingface-cli upload USER/NAME FOLDER`` does that.
"""

import argparse
import shutil
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_policyflow.benchmark.errors import BenchmarkError, at_least, require_env
from sb3_policyflow.benchmark.measure.evaluation import MODES, evaluate, modes
from sb3_policyflow.benchmark.measure.provenance import versions
from sb3_policyflow.benchmark.report.markdown import markdown_table
from sb3_policyflow.common.algorithm import FlowOnPolicyAlgorithm
from sb3_policyflow.export import load_model
from sb3_policyflow.resilience.files import saved_model
from sb3_policyflow.resilience.normalization import check_normalization, read_statistics


def write_card(
    model_path: str | Path,
    env_id: str,
    folder: str | Path,
    statistics: str | Path | None = None,
    n_episodes: int = 20,
) -> Path:
    """Evaluate a saved model and write a folder with it and its model card.

    :param model_path: The model's zip file.
    :param env_id: The environment to evaluate it in.
    :param folder: Where ``README.md``, the model and the statistics go.
    :param statistics: What ``VecNormalize.save`` wrote; needed if observations were normalized.
    :param n_episodes: Episodes of each way to act.
    :return: The model card.
    :raises BenchmarkError: If the environment does not exist, the model cannot be loaded, or the
        statistics are missing, of another environment, or not of the model's training.
    """
    require_env(env_id)
    model_path, folder = saved_model(model_path), Path(folder)
    try:
        model = load_model(model_path)
        env = _environment(env_id, model, statistics)
    except ValueError as error:
        raise BenchmarkError(str(error)) from error
    evaluations = [evaluate(model, env, mode, n_episodes) for mode in modes(model)]
    env.close()
    folder.mkdir(parents=True, exist_ok=True)
    files = [model_path] if statistics is None else [model_path, Path(statistics)]
    for file in files:
        shutil.copy(file, folder / file.name)
    card = folder / "README.md"
    name = type(model).__name__
    card.write_text(card_text(name, env_id, model_path.name, model, evaluations), encoding="utf-8")
    return card


def _environment(
    env_id: str, model: FlowOnPolicyAlgorithm, statistics: str | Path | None
) -> VecEnv:
    """The environment, as a model saw it in training."""
    normalize = None if statistics is None else read_statistics(statistics)
    check_normalization(model, normalize, "statistics")
    env: VecEnv = make_vec_env(env_id, 1)
    if normalize is None:
        return env
    try:
        normalize.set_venv(env)
    except AssertionError as error:
        raise ValueError(
            f"{statistics} is of another environment than {env_id} ({error}): give the statistics "
            "of the model's training."
        ) from error
    normalize.training, normalize.norm_reward = False, False
    return normalize


def card_text(
    name: str, env_id: str, file: str, model: Any, evaluations: list[dict[str, Any]]
) -> str:
    """The model card, in Hugging Face's format: data in YAML, and a page in Markdown.

    :param name: The algorithm's class.
    :param env_id: The environment.
    :param file: Name of the model's file.
    :param model: The model.
    :param evaluations: What :func:`evaluate` returned, the stochastic one first.
    """
    scores = [f"{e['mean_return']:.2f} +/- {e['std_return']:.2f}" for e in evaluations]
    metric = {"type": "mean_reward", "name": "mean_reward", "verified": False, "value": scores[0]}
    result = {
        "task": {"type": "reinforcement-learning", "name": "reinforcement-learning"},
        "dataset": {"name": env_id, "type": env_id},
        "metrics": [metric],
    }
    data = {
        "library_name": "stable-baselines3",
        "tags": [env_id, "deep-reinforcement-learning", "reinforcement-learning", "sb3-policyflow"],
        "model-index": [{"name": name, "results": [result]}],
    }
    header = ("actions", "mean return +/- standard deviation", "episodes")
    rows = [
        (f"{e['mode']} ({MODES[e['mode']]})", score, str(e["n_episodes"]))
        for e, score in zip(evaluations, scores, strict=True)
    ]
    used = [(package, version) for package, version in versions().items() if version]
    return (
        "\n\n".join(
            [
                f"---\n{yaml.safe_dump(data, sort_keys=False)}---",
                f"# {name} on {env_id}",
                f"A policy trained by {name} (package sb3-policyflow) for {model.num_timesteps:,} "
                "steps. Evaluated on the same starts in each row:",
                markdown_table(header, rows),
                f"```python\nfrom sb3_policyflow import {name}\n\n"
                f'model = {name}.load("{file}")\n```',
                "Evaluated with:",
                markdown_table(("", "version"), used),
            ]
        )
        + "\n"
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("model", type=Path, help="the model's zip file")
    parser.add_argument("--env", required=True, help="id of the environment")
    parser.add_argument("--out", type=Path, default=Path("card"), help="a folder; default: card")
    parser.add_argument("--vecnormalize", type=Path, help="what VecNormalize.save wrote")
    parser.add_argument(
        "--episodes", type=at_least(1), default=20, help="of each way to act; default: 20"
    )


def main(arguments: argparse.Namespace) -> int:
    """Write the folder."""
    for file in (saved_model(arguments.model), arguments.vecnormalize):
        if file is not None and not file.is_file():
            raise BenchmarkError(f"There is no file {file}.")
    card = write_card(
        arguments.model, arguments.env, arguments.out, arguments.vecnormalize, arguments.episodes
    )
    print(f"Wrote {card} and, beside it, the model.")
    return 0
